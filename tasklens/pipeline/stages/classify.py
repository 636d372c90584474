"""Fine-tuning and measurement of a classifier on the captures of a lens, and reproduction with its stored weights."""

import torch

from restoration.nafnet import build
from tasklens.imaging import Camera
from tasklens.recognition import classifiers, dataset, evaluation, training
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.distributed import process_group
from tasklens.runtime.files import Files, read_tensors, write_rows, write_tensors
from tasklens.study.settings import Slice


def fine_tune(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the weights, the metrics of every field, and the prediction for every test image."""
    with process_group() as group:
        splits = {name: dataset.read(*files, device=group.device) for name, files in inputs.images.items()}
        classifier = classifiers.build(settings.classifier, splits["train"].classes, inputs.weights).to(group.device)
        pipeline = _capture_pipeline(settings, inputs, group.device)
        rows = evaluation.zero_shot(classifier.eval(), splits["test"], pipeline, checkpoint) if group.is_first else []
        capture = pipeline.one_field
        training.fit(
            classifier, splits["train"], settings.training, settings.seed, "fine-tune", capture, checkpoint, group
        )
    if not group.is_first:
        return
    metrics, predictions = evaluation.measure(classifier, splits, pipeline, checkpoint)
    write_tensors(outputs.weights, classifier.network.state_dict(), {"model": settings.classifier.model})
    write_rows(outputs.metrics, [settings.rows | row for row in rows + metrics])
    write_rows(outputs.predictions, predictions)


def reproduce(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the predictions of the stored weights through the stored PSFs."""
    device = claim()
    test = dataset.read(*inputs.test, device=device)
    classifier = classifiers.build(settings.classifier, test.classes, inputs.weights).eval().to(device)
    correct, _ = evaluation.evaluate(classifier, test, _capture_pipeline(settings, inputs, device), "test", checkpoint)
    write_rows(outputs.predictions, evaluation.predictions_by_image(correct, test))


def _capture_pipeline(settings: Slice, inputs: Files, device: torch.device) -> CapturePipeline:
    """Build the capture pipeline from cached PSFs, if any, and the trained restoration, if any."""
    camera = network = None
    if settings.capture is not None:
        psf = read_tensors(inputs.psf)[0]["psf"].to(device)
        camera = Camera(psf, settings.capture.outside_window, settings.capture.colour)
    if settings.restoration is not None:
        network = build(settings.restoration).eval().requires_grad_(False)
        network.load_state_dict(read_tensors(inputs.restoration)[0])
        network.to(device)
    return CapturePipeline(camera, network)
