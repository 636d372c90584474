"""The stages that make and measure: images, classifiers, lenses, PSFs, restorations, accuracies.

Each is a function of settings, inputs and outputs, and of a checkpoint if it takes long. torch is imported inside.
"""

import sys
from typing import TYPE_CHECKING

from tasklens.pipeline.stage import Files, Slice

if TYPE_CHECKING:
    import torch

    from tasklens.recognition.evaluation import CapturePipeline
    from tasklens.runtime.checkpoints import Checkpoint
    from tasklens.study.design_settings import LensDesign
    from tasklens.study.settings import ClassifierSettings


def images(settings: Slice, inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """render or read the images and cut them into train, minival and test"""
    from tasklens.recognition import dataset

    paths = {name: (getattr(outputs, name), getattr(outputs, f"{name}_labels")) for name in dataset.SPLITS}
    dataset.make(settings.images, paths, checkpoint)
    for name, files in paths.items():
        split = dataset.read(*files)
        print(f"{name}: {len(split)} images of {len(split.classes)} classes", file=sys.stderr)


def reference(settings: "ClassifierSettings", inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """train a classifier on the sharp images, or take its published weights"""
    from tasklens.recognition import classifiers, dataset, training
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_tensors

    device = claim()
    train = dataset.read(*inputs.train, device=device)
    training.reseed(0)
    classifier = classifiers.build(settings, train.classes).to(device)
    if settings.training is not None:
        training.fit(classifier, train, settings.training, 0, "reference", checkpoint=checkpoint)
    write_tensors(outputs.weights, classifier.network.state_dict(), {"model": settings.model})


def design(settings: "LensDesign", inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """design a lens, or import it, and write its prescription, figures and history"""
    from tasklens.design import methods
    from tasklens.optics.io import prescription
    from tasklens.recognition import classifiers, dataset
    from tasklens.recognition.metrics import mean_metrics
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_rows

    classifier = train = None
    if settings.classifier is not None:
        device = claim()
        train = dataset.read(*inputs.train, device=device)
        classifier = classifiers.build(settings.classifier, train.classes, inputs.weights).to(device)
    baselines = {
        name: (prescription.read(path)[0].lens, mean_metrics(inputs.metrics[name])["minival_accuracy"])
        for name, path in inputs.baselines.items()
    }
    lens, notes, history = methods.design(settings, classifier, train, baselines, checkpoint)
    write_rows(outputs.history, history)
    prescription.write(outputs.lens, prescription.Prescription(lens), notes)


def psf(settings: Slice, inputs: Files, outputs: Files) -> None:
    """trace the PSF grid of a lens once, for everything after it"""
    from tasklens.optics.analysis.spots import evaluation_psf
    from tasklens.optics.io import prescription
    from tasklens.optics.view import view_of_spec
    from tasklens.runtime.files import write_tensors

    spec = settings.spec
    grid = evaluation_psf(prescription.read(inputs.lens)[0].lens, view_of_spec(spec), settings.rays)
    notes = {
        "fields_mm": spec.fields_mm,
        "wavelengths_um": spec.wavelengths_um,
        "pixel_pitch_um": spec.pixel_pitch_um,
        "energy_inside": grid.sum((-2, -1)).tolist(),
        "rays": settings.rays,
    }
    write_tensors(outputs.psf, {"psf": grid.float()}, notes)


def tail(settings: Slice, inputs: Files, outputs: Files) -> None:
    """trace how the light of a lens spreads: core, tail, and energy encircled by each radius"""
    from tasklens.optics.analysis.tail import tail
    from tasklens.optics.io import prescription
    from tasklens.optics.view import view_of_spec
    from tasklens.runtime.files import write_rows

    by_field, curve = tail(prescription.read(inputs.lens)[0].lens, view_of_spec(settings.spec), settings.rays)
    write_rows(outputs.psf_tail, by_field)
    write_rows(outputs.encircled_energy, curve)


def restore(settings: Slice, inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """train the restoration network on the captures of a lens"""
    from restoration import training
    from tasklens.imaging import Camera
    from tasklens.recognition import dataset
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import read_tensors, write_rows, write_tensors

    device, capture = claim(), settings.capture
    camera = Camera(read_tensors(inputs.psf)[0]["psf"].to(device), capture.outside_window, capture.colour)
    train, minival = (dataset.read(*inputs.images[name], device=device) for name in ("train", "minival"))
    network, history = training.train(settings.restoration, train, minival, camera, settings.seed, checkpoint)
    write_rows(outputs.history, history)
    write_tensors(outputs.weights, network.state_dict(), {})


def fine_tune(settings: Slice, inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """fine-tune a classifier on the captures of a lens, and measure it on every field"""
    from tasklens.recognition import classifiers, dataset, evaluation, training
    from tasklens.runtime.distributed import process_group
    from tasklens.runtime.files import write_rows, write_tensors

    with process_group() as group:
        splits = {name: dataset.read(*files, device=group.device) for name, files in inputs.images.items()}
        classifier = classifiers.build(settings.classifier, splits["train"].classes, inputs.weights).to(group.device)
        pipeline = _capture_pipeline(settings, inputs, group.device)
        rows = evaluation.zero_shot(classifier.eval(), splits["test"], pipeline, checkpoint) if group.is_first else []
        see = pipeline.one_field
        training.fit(classifier, splits["train"], settings.training, settings.seed, "fine-tune", see, checkpoint, group)
    if not group.is_first:
        return
    metrics, predictions = evaluation.measure(classifier, splits, pipeline, checkpoint)
    write_tensors(outputs.weights, classifier.network.state_dict(), {"model": settings.classifier.model})
    write_rows(outputs.metrics, [settings.rows | row for row in rows + metrics])
    write_rows(outputs.predictions, predictions)


def reproduce(settings: Slice, inputs: Files, outputs: Files, checkpoint: "Checkpoint") -> None:
    """classify the test images again with the stored weights, through the stored PSFs"""
    from tasklens.recognition import classifiers, dataset, evaluation
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_rows

    device = claim()
    test = dataset.read(*inputs.test, device=device)
    classifier = classifiers.build(settings.classifier, test.classes, inputs.weights).eval().to(device)
    pipeline = _capture_pipeline(settings, inputs, device)
    correct, _ = evaluation.evaluate(classifier, test, pipeline, "test", checkpoint)
    write_rows(outputs.predictions, evaluation.predictions_by_image(correct, test))


def _capture_pipeline(settings: Slice, inputs: Files, device: "torch.device") -> "CapturePipeline":
    """From an image to a classifier: through the cached PSFs, or none, and the trained restoration, or none."""
    from restoration.nafnet import build
    from tasklens.imaging import Camera
    from tasklens.recognition.evaluation import CapturePipeline
    from tasklens.runtime.files import read_tensors

    camera = network = None
    if settings.capture is not None:
        psf = read_tensors(inputs.psf)[0]["psf"].to(device)
        camera = Camera(psf, settings.capture.outside_window, settings.capture.colour)
    if settings.restoration is not None:
        network = build(settings.restoration).eval().requires_grad_(False)
        network.load_state_dict(read_tensors(inputs.restoration)[0])
        network.to(device)
    return CapturePipeline(camera, network)
