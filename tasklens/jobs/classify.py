"""Fine-tuning and measurement of a classifier on captures of a lens, and reproduction from stored weights."""

from collections.abc import Sequence
from pathlib import Path

import torch

from restoration import nafnet
from tasklens.imaging import PsfCamera
from tasklens.optics.io import psf_files
from tasklens.recognition import classifiers, dataset, evaluation, training
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.distributed import process_group
from tasklens.runtime.files import write_rows, write_tensors
from tasklens.study.job_settings import CapturePipelineSettings, FineTuningJob, ReproductionJob


def fine_tune(
    settings: FineTuningJob,
    train: Sequence[Path],
    minival: Sequence[Path],
    test: Sequence[Path],
    psf: Path | None,
    restoration: Path | None,
    reference: Path,
    weights: Path,
    metrics: Path,
    predictions: Path,
    frozen: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write weights, metrics by field, predictions by test image, and pre-training losses by minival image.

    Args:
        psf: PSFs of the lens; None for sharp images.
        restoration: weights of the restoration network; None for unrestored captures.
        reference: weights of the classifier that was trained on the sharp images.
    """
    with process_group() as group:
        training_images, selection, images = (
            dataset.read(*split, device=group.device) for split in (train, minival, test)
        )
        network = classifiers.build(settings.classifier, training_images.classes, reference).to(group.device)
        pipeline = _capture_pipeline(settings, psf, restoration, group.device)
        if group.is_first:
            initial_network = classifiers.frozen(network, images.images)
            before = evaluation.evaluate(initial_network, selection, pipeline, "minival, before training", checkpoint)
            zero_shot, on_test = [], None
            if not settings.training.epochs or network.has_more_outputs:
                on_test = evaluation.evaluate(initial_network, images, pipeline, "test, before training", checkpoint)
                zero_shot = evaluation.zero_shot(network, on_test)
        training.fit(
            network,
            training_images,
            settings.training,
            settings.seed,
            "fine-tune",
            pipeline.one_field,
            checkpoint,
            group,
        )
    if not group.is_first:
        return
    final_network, after = classifiers.frozen(network, images.images), before
    if settings.training.epochs or on_test is None:
        on_test = evaluation.evaluate(final_network, images, pipeline, "test", checkpoint)
        after = evaluation.evaluate(final_network, selection, pipeline, "minival", checkpoint)
    rows = evaluation.measure(network, images, on_test, after, pipeline.camera is not None)
    write_tensors(weights, network.network.state_dict(), {"model": settings.classifier.model})
    write_rows(frozen, evaluation.by_image(before.losses, selection))
    write_rows(metrics, [settings.columns | row for row in zero_shot + rows])
    write_rows(predictions, evaluation.by_image(on_test.correct.int(), images))


def reproduce(
    settings: ReproductionJob,
    test: Sequence[Path],
    psf: Path | None,
    restoration: Path | None,
    weights: Path,
    predictions: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write the predictions of a classifier with stored weights, on captures with stored PSFs."""
    device = claim()
    images = dataset.read(*test, device=device)
    network = classifiers.build(settings.classifier, images.classes, weights).to(device)
    classifier = classifiers.frozen(network, images.images)
    pipeline = _capture_pipeline(settings, psf, restoration, device)
    correct = evaluation.evaluate(classifier, images, pipeline, "test", checkpoint).correct
    write_rows(predictions, evaluation.by_image(correct.int(), images))


def _capture_pipeline(
    settings: CapturePipelineSettings, psf: Path | None, restoration: Path | None, device: torch.device
) -> CapturePipeline:
    """Build the capture pipeline from cached PSFs, if any, and the trained restoration, if any."""
    camera = network = None
    if settings.capture is not None:
        assert psf is not None  # captures need the PSFs of a lens
        camera = PsfCamera.of(settings.capture, *(tensor.to(device) for tensor in psf_files.read(psf)))
    if settings.restoration is not None:
        assert restoration is not None  # weights of the network
        network = nafnet.load(settings.restoration, restoration).to(device)
    return CapturePipeline(camera, network)
