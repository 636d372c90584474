"""Figure of whole frames through the task-driven and the best imaging lens of some elements (the paper's figure 4)."""

import torch
from torch import Tensor

from tasklens.imaging import Camera
from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.io import prescription
from tasklens.recognition import dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.report import frames, predictions
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files, read_tensors
from tasklens.simulation.charts import resolution_chart
from tasklens.simulation.field_psfs import pitch_on_sensor, trace_field_psfs
from tasklens.simulation.sensor import capture
from tasklens.study.settings import Slice

_SHAPE = 540, 960  # of the frames [pixels]
_FIELD = 4  # the middle one of nine
_RULE = "Last rows: the first test images in file order that only one lens' network recognises at the middle field"


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw a chart and test images side by side as frames, and single captures on which two networks disagree.

    The frames have neither noise nor levels, the single captures what the study gives them.
    """
    claim = settings.claim
    strongest = Measurements({}, inputs.metrics).strongest_baseline(claim, settings.seed)
    test = dataset.read(*inputs.test)
    sources = {"chart": resolution_chart(*_SHAPE), "test images": _tiled(test)}
    shown = {name: {"sharp": image} for name, image in sources.items()}
    for lens in (claim.lens, strongest):
        found, content = prescription.read(inputs.lenses[lens])
        view = view_of(found.lens, content, str(inputs.lenses[lens]))
        pitch = pitch_on_sensor(view, _SHAPE)
        psfs = trace_field_psfs(found.lens, view, _SHAPE, pitch)
        for name, image in sources.items():
            shown[name][lens] = capture(image, psfs, settings.captures[lens].colour)
    title = f"{_SHAPE[0]} x {_SHAPE[1]} pixels of {pitch:.2f} um fill the sensor; networks: {claim.classifier}"
    answered = _disagreements(settings, inputs, test, claim.lens, strongest)
    frames.draw(outputs.figure, title, shown, answered, _RULE)


def _tiled(test: ImageDataset) -> Tensor:
    """Return the first test images row by row as one frame (3, H, W); from the beginning again if they are too few."""
    side = test.images.shape[-1]
    rows, columns = (-(-n // side) for n in _SHAPE)
    images, _ = test.batch(torch.arange(rows * columns) % len(test))
    whole = images.unflatten(0, (rows, columns)).permute(2, 0, 3, 1, 4).flatten(1, 2).flatten(2, 3)
    return whole[:, : _SHAPE[0], : _SHAPE[1]]


def _disagreements(settings: Slice, inputs: Files, test: ImageDataset, *lenses: str) -> list[frames.Answered]:
    """Return the first image that only the first lens' network recognises, and the first that only the second's does.

    There are fewer if the networks do not disagree so.
    """
    correct = {lens: predictions.read(inputs.predictions[lens]).iloc[:, _FIELD] == 1 for lens in lenses}
    predictions.same_images(correct[lenses[0]], correct[lenses[1]], " and ".join(lenses))
    answered = []
    for one, other in (lenses, lenses[::-1]):
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
    how, tensors = settings.captures[lens], read_tensors(inputs.psfs[lens])[0]
    psf, illumination = tensors["psf"][[_FIELD]], tensors["illumination"][[_FIELD]]
    return Camera(psf, how.outside_window, how.colour, how.sensor, illumination).grid(images)[0, 0]
