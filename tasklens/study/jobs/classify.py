"""Fine-tuning and measurement of a classifier on captures of a lens, and reproduction from stored weights."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from restoration import nafnet
from tasklens.recognition import classifiers, dataset, evaluation, training
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
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

    Networks are trained at fields that are drawn, chosen at others, and graded at fields that neither used.

    Args:
        psf: PSFs of the lens; None for sharp images.
        restoration: weights of the restoration network; None for unrestored captures.
        reference: weights of the classifier that was trained on the sharp images.
    """
    device = claim()
    training_images, selection, images = (dataset.read(*split, device=device) for split in (train, minival, test))
    network = classifiers.build(settings.classifier, training_images.classes, reference).to(device)
    pipeline = _pipelines(settings, psf, restoration, device)
    choice = pipeline("selection")
    initial_network = classifiers.frozen(network, images.images)
    before = evaluation.evaluate(initial_network, selection, choice, "minival, before training", checkpoint)
    zero_shot, untrained = [], None
    if network.has_more_outputs:
        part = pipeline("grading"), "test, before training", checkpoint
        untrained = evaluation.evaluate(initial_network, images, *part)
        zero_shot = evaluation.rows({"zero_shot_accuracy": 100 * untrained.among_all.double().mean(-1)})
    training.fit(
        network,
        training_images,
        settings.training,
        settings.seed,
        "fine-tune",
        pipeline("training").one_field,
        checkpoint,
    )
    final_network, after = classifiers.frozen(network, images.images), before
    if settings.training.epochs:
        after = evaluation.evaluate(final_network, selection, choice, "minival", checkpoint)
    graded = {} if untrained is None or settings.training.epochs else {"grading": untrained}
    for fields in settings.graded.values():
        if fields not in graded:
            part = pipeline(fields), f"test, {fields}", checkpoint
            graded[fields] = evaluation.evaluate(final_network, images, *part)
    test_by_metric = {metric: graded[fields] for metric, fields in settings.graded.items()}
    rows = evaluation.measure(network, images, test_by_metric, after, settings.capture is not None)
    correct = {"field" if fields == "grading" else fields: part.correct.int() for fields, part in graded.items()}
    write_tensors(weights, network.network.state_dict(), {"model": settings.classifier.model})
    write_rows(frozen, evaluation.by_image({"field": before.losses}, selection))
    write_rows(metrics, [settings.columns | row for row in zero_shot + rows])
    write_rows(predictions, evaluation.by_image(correct, images))


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
    pipeline = _pipelines(settings, psf, restoration, device)("grading")
    correct = evaluation.evaluate(classifier, images, pipeline, "test", checkpoint).correct
    write_rows(predictions, evaluation.by_image({"field": correct.int()}, images))


def _pipelines(
    settings: CapturePipelineSettings, psf: Path | None, restoration: Path | None, device: torch.device
) -> Callable[[str], CapturePipeline]:
    """Return the capture pipelines by set of fields, from cached PSFs and the trained restoration, if any."""
    network = None
    if settings.restoration is not None:
        assert restoration is not None  # weights of the network
        network = nafnet.load(settings.restoration, restoration).to(device)
    return partial(CapturePipeline.of, settings.capture, psf, device=device, network=network)
