"""Figure of whole frames through the task-driven lenses and the best imaging lens (the paper's figure 4)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tasklens.imaging import Camera
from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.io import prescription, psf_files
from tasklens.recognition import dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.report import frames, predictions
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files
from tasklens.simulation.charts import resolution_chart
from tasklens.simulation.field_psfs import pitch_on_sensor, trace_field_psfs
from tasklens.simulation.sensor import capture
from tasklens.study.settings import Slice

_SHAPE = 1080, 1920  # of the frames [pixels]
_FIELD = 4  # the middle one of nine
_RULE = (
    "Last rows: the first test image in file order that the network of {one} recognises at the middle field\n"
    "and that of {other} does not, and the first of which the opposite is true; where there are such"
)


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw a chart and test images side by side as frames, and single captures on which two networks disagree.

    The frames have neither noise nor levels, the single captures what the study gives them.
    """
    first = settings.claims[0]
    strongest = Measurements({}, inputs.metrics).strongest_baseline(first, settings.seed)
    lenses = [*(claim.lens for claim in settings.claims), strongest]
    test = dataset.read(*inputs.test)
    sources = {"chart": resolution_chart(*_SHAPE), "test images": _tiled(test)}
    shown = {name: {"sharp": image} for name, image in sources.items()}
    for lens in lenses:
        found, content = prescription.read(inputs.lenses[lens])
        view = view_of(found.lens, content, str(inputs.lenses[lens]))
        pitch = pitch_on_sensor(view, _SHAPE)
        psfs = trace_field_psfs(found.lens, view, _SHAPE, pitch)
        for name, image in sources.items():
            shown[name][lens] = capture(image, psfs, settings.captures[lens].colour)
    title = f"{_SHAPE[0]} x {_SHAPE[1]} pixels of {pitch:.2f} um fill the sensor; networks: {first.classifier}"
    answered = _disagreements(settings, inputs, test, lenses)
    frames.draw(outputs.figure, title, shown, answered, _RULE.format(one=first.lens, other=strongest))


def _tiled(test: ImageDataset) -> Tensor:
    """Return the first test images row by row as one frame (3, H, W); from the beginning again if they are too few."""
    side = test.images.shape[-1]
    rows, columns = (-(-n // side) for n in _SHAPE)
    images, _ = test.batch(torch.arange(rows * columns) % len(test))
    whole = images.unflatten(0, (rows, columns)).permute(2, 0, 3, 1, 4).flatten(1, 2).flatten(2, 3)
    return whole[:, : _SHAPE[0], : _SHAPE[1]]


def _disagreements(settings: Slice, inputs: Files, test: ImageDataset, lenses: Sequence[str]) -> list[frames.Answered]:
    """Return the first image that the first lens' network recognises and the last one's does not; and the opposite.

    There are fewer if the networks do not disagree so.
    """
    correct = {lens: predictions.read(inputs.predictions[lens]).iloc[:, _FIELD] == 1 for lens in lenses}
    for lens in lenses[1:]:
        predictions.same_images(correct[lenses[0]], correct[lens], f"{lenses[0]} and {lens}")
    answered = []
    for one, other in ((lenses[0], lenses[-1]), (lenses[-1], lenses[0])):
        only = correct[one] & ~correct[other]
        if not only.any():
            continue
        row = int(only.argmax())
        image, label = only.index[row]
        images, _ = test.batch(torch.tensor([int(image)]))
        captures = {lens: _single(settings, inputs, lens, images) for lens in lenses}
        answers = {lens: bool(correct[lens].iloc[row]) for lens in lenses}
        answered.append(frames.Answered(f"test image {image}, {label}", {"sharp": images[0], **captures}, answers))
    return answered


def _single(settings: Slice, inputs: Files, lens: str, images: Tensor) -> Tensor:
    """Return the capture (3, H, W) of one image at the middle field."""
    of_field = (tensor[[_FIELD]] for tensor in psf_files.read(inputs.psfs[lens]))
    return Camera.of(settings.captures[lens], *of_field).grid(images)[0, 0]
