"""Fine-tuning and measurement of a classifier on the captures of a lens, and reproduction with its stored weights."""

from collections.abc import Mapping

import torch

from restoration import nafnet
from tasklens.imaging import Camera
from tasklens.optics.io import psf_files
from tasklens.recognition import classifiers, dataset, evaluation, training
from tasklens.recognition.classifiers import Classifier
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.distributed import process_group
from tasklens.runtime.files import Files, write_rows, write_tensors
from tasklens.study.settings import Slice

_OUTPUTS = ("weights", "metrics", "predictions", "frozen")


def fine_tune(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write weights, metrics by field, predictions by test image, and losses before the training by minival image."""
    _fine_tune(settings, inputs, dict.fromkeys(settings.classifiers, outputs), checkpoint)


def fine_tune_others(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the same of several classifiers."""
    paths = vars(outputs)
    by_name = {n: Files(**{key: paths[f"{key}_{n}"] for key in _OUTPUTS}) for n in settings.classifiers}
    _fine_tune(settings, inputs, by_name, checkpoint)


def _fine_tune(settings: Slice, inputs: Files, outputs: Mapping[str, Files], checkpoint: Checkpoint) -> None:
    """Fine-tune and measure classifiers, all on the same captures, which are rendered once."""
    with process_group() as group:
        splits = {name: dataset.read(*files, device=group.device) for name, files in inputs.images.items()}
        networks = {
            name: classifiers.build(each, splits["train"].classes, inputs.weights[name]).to(group.device)
            for name, each in settings.classifiers.items()
        }
        pipeline = _capture_pipeline(settings, inputs, group.device)
        zero_shot: dict[str, list[dict]] = {}
        if group.is_first:
            untrained = _frozen(networks, splits["test"])
            for name, network in zip(networks, untrained, strict=True):
                label = f"zero-shot evaluation of {name}"
                zero_shot[name] = evaluation.zero_shot(network, splits["test"], pipeline, label, checkpoint)
            before = evaluation.evaluate(untrained, splits["minival"], pipeline, "minival, before training", checkpoint)
        training.fit(
            networks,
            splits["train"],
            settings.training,
            settings.seed,
            "fine-tune",
            pipeline.one_field,
            checkpoint,
            group,
        )
    if not group.is_first:
        return
    trained, after = _frozen(networks, splits["test"]), before
    test = evaluation.evaluate(trained, splits["test"], pipeline, "test", checkpoint)
    if settings.training.epochs:
        after = evaluation.evaluate(trained, splits["minival"], pipeline, "minival", checkpoint)
    measured = evaluation.measure(list(networks.values()), splits["test"], test, after, pipeline.camera is not None)
    for (name, network), losses, (metrics, predictions) in zip(networks.items(), before.losses, measured, strict=True):
        model = {"model": settings.classifiers[name].model}
        write_tensors(outputs[name].weights, network.network.state_dict(), model)
        rows = settings.rows | {"classifier": name}
        write_rows(outputs[name].frozen, evaluation.by_image(losses, splits["minival"]))
        write_rows(outputs[name].metrics, [rows | row for row in zero_shot[name] + metrics])
        write_rows(outputs[name].predictions, predictions)


def _frozen(networks: Mapping[str, Classifier], images: ImageDataset) -> list[Classifier]:
    return [classifiers.frozen(network, images.images) for network in networks.values()]


def reproduce(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the predictions of the stored weights through the stored PSFs."""
    device = claim()
    test = dataset.read(*inputs.test, device=device)
    trained = classifiers.build(settings.classifier, test.classes, inputs.weights).to(device)
    classifier = classifiers.frozen(trained, test.images)
    pipeline = _capture_pipeline(settings, inputs, device)
    correct = evaluation.evaluate([classifier], test, pipeline, "test", checkpoint).correct[0]
    write_rows(outputs.predictions, evaluation.by_image(correct.int(), test))


def _capture_pipeline(settings: Slice, inputs: Files, device: torch.device) -> CapturePipeline:
    """Build the capture pipeline from cached PSFs, if any, and the trained restoration, if any."""
    camera = network = None
    if settings.capture is not None:
        camera = Camera.of(settings.capture, *(tensor.to(device) for tensor in psf_files.read(inputs.psf)))
    if settings.restoration is not None:
        network = nafnet.load(settings.restoration, inputs.restoration).to(device)
    return CapturePipeline(camera, network)
