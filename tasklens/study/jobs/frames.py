"""Figure of whole frames captured with task-driven lenses and the best imaging lens (the paper's figure 4)."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from tasklens.camera.blend import capture
from tasklens.camera.imaging import PsfCamera
from tasklens.camera.sensor_psfs import pitch_on_sensor, trace_sensor_psfs
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.spec_section import view_of
from tasklens.optics.view import View
from tasklens.recognition import dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.show import predictions
from tasklens.show.figures import save
from tasklens.study.jobs.lens_figures import lenses_to_draw
from tasklens.study.report_jobs import FramesJob

_SHAPE = 1080, 1920  # largest frame [pixels]
_ZOOM = 96, 144  # height and width of a zoomed patch [pixels]
# Centre of each patch [share of the height, share of the width], and its colour.
_PATCHES = {"centre": (0.5, 0.5, "#0072B2"), "off axis": (0.81, 0.81, "#D55E00")}
_DPI = 130
_RULE = (
    "Last rows: the first test image in file order that the network of {one} recognises halfway to the corner\nbut "
    "that of {other} does not, and the first one vice versa, if there are any"
)
_SPOKES = 24  # pairs of a star of the chart
_RADIUS = 0.18  # radius of a star, in chart heights
_STARS = ((0.0, 0.0), (-0.31, -0.31), (-0.31, 0.31), (0.31, -0.31), (0.31, 0.31))  # places, in height and width
_PERIODS = (2, 3, 4, 6, 8)  # periods of the line pairs [pixels]
_BARS = 4  # line pairs per period
_OVERSAMPLING = 4  # samples per pixel, against aliasing


def run(
    settings: FramesJob,
    lenses: Sequence[Path],
    psfs: Sequence[Path],
    metrics: Sequence[Path],
    test: Sequence[Path],
    correct: Sequence[Path],
    figure: Path,
) -> None:
    """Draw a chart and test images side by side as frames, and single captures on which two networks disagree.

    The frames have no noise, quantisation or diffraction; the single captures have the settings of the study.

    Args:
        lenses, psfs, correct: files of the lenses in `settings.captures`, and predictions of the supervising
            classifier.
        metrics: measurements of `settings.comparison.baseline_keys`.
    """
    lens_of = dict(zip(settings.captures, lenses, strict=True))
    names = lenses_to_draw(settings.comparison, metrics)
    images = dataset.read(*test)
    read = {lens: prescription.read(lens_of[lens]) for lens in names}
    views = {lens: view_of(read[lens][0].lens, content, str(lens_of[lens])) for lens, (_, content) in read.items()}
    shape = _frame_shape(views[names[0]])
    sources = {"chart": resolution_chart(*shape), "test images": _tile(images, shape)}
    rows = {name: {"sharp": image} for name, image in sources.items()}
    for lens, view in views.items():
        design = read[lens][0].lens
        pitch = pitch_on_sensor(design, view, shape)
        sensor_psfs = trace_sensor_psfs(design, view, shape, pitch)
        for name, image in sources.items():
            rows[name][lens] = capture(image, sensor_psfs, settings.captures[lens].colour)
    network = settings.comparison.claims[0].classifier
    title = f"{shape[0]} x {shape[1]} pixels of {pitch:.2f} um fill the sensor; networks: {network}"
    psf_of, correct_of = (dict(zip(settings.captures, paths, strict=True)) for paths in (psfs, correct))
    by_lens = {lens: (psf_of[lens], correct_of[lens]) for lens in names}
    disagreements = _disagreements(settings, by_lens, images)
    draw(figure, title, rows, disagreements, _RULE.format(one=names[0], other=names[-1]))


def resolution_chart(height: int, width: int) -> Tensor:
    """Return a black-and-white chart (3, H, W) of Siemens stars and line pairs; each pixel is the mean over its area.

    Groups of vertical and horizontal line pairs lie between the stars, with `_PERIODS` in order from the centre.
    """
    fine = height * _OVERSAMPLING, width * _OVERSAMPLING
    y, x = ((torch.arange(n) + 0.5) / _OVERSAMPLING - n / _OVERSAMPLING / 2 for n in fine)
    chart = torch.ones(fine)
    for row, column in _STARS:
        across, along = x[None] - column * width, y[:, None] - row * height
        spokes = torch.sin(_SPOKES * torch.atan2(along, across)) > 0
        chart[spokes & (torch.hypot(across, along) < _RADIUS * height)] = 0
    for side in (-1, 1):
        _bars(chart, x, y, side, _RADIUS * height * 1.15)
        _bars(chart.T, y, x, side, _RADIUS * height * 1.15)
    return chart.unflatten(0, (height, -1)).unflatten(2, (width, -1)).mean((1, 3)).expand(3, height, width).contiguous()


def _bars(chart: Tensor, x: Tensor, y: Tensor, side: int, start: float) -> None:
    """Draw groups of line pairs in sequence along x, on one side of the centre, from |x| = start."""
    for period in _PERIODS:
        length = math.ceil(_BARS * period / 2) * 2
        position = side * x - start
        dark = (position >= 0) & (position < length) & (torch.remainder(position, period) < period / 2)
        chart[(y.abs() < 16)[:, None] & dark[None]] = 0
        start += length + 8


def _frame_shape(view: View) -> tuple[int, int]:
    """Return height and width of a frame: at most 1080 x 1920, and not more pixels than the sensor has."""
    diagonal = 2e3 * float(view.radii.max()) / view.pixel_pitch_um
    scale = min(1.0, diagonal / math.hypot(*_SHAPE))
    return int(scale * _SHAPE[0]), int(scale * _SHAPE[1])


def _tile(test: ImageDataset, shape: tuple[int, int]) -> Tensor:
    """Tile the first test images row by row into one frame (3, H, W); repeat them if there are too few."""
    side = test.images.shape[-1]
    rows, columns = (-(-n // side) for n in shape)
    images, _ = test.batch(torch.arange(rows * columns) % len(test))
    frame = images.unflatten(0, (rows, columns)).permute(2, 0, 3, 1, 4).flatten(1, 2).flatten(2, 3)
    return frame[:, : shape[0], : shape[1]]


def _disagreements(
    settings: FramesJob, files: Mapping[str, tuple[Path, Path]], test: ImageDataset
) -> list[dict[str, tuple[str, Tensor]]]:
    """Return the first image that only the network of the first lens recognises, and the same for the last lens.

    The list is shorter if there is no such image. An entry has the caption and the image (3, H, W) of each column: the
    sharp image, and its captures through the lenses at one field.

    Args:
        files: PSFs and predictions by lens.
    """
    lenses = list(files)
    correct = {lens: predictions.read(path).iloc[:, settings.field] == 1 for lens, (_, path) in files.items()}
    for lens in lenses[1:]:
        predictions.same_images(correct[lenses[0]], correct[lens], f"{lenses[0]} and {lens}")
    disagreements = []
    for one, other in ((lenses[0], lenses[-1]), (lenses[-1], lenses[0])):
        only = correct[one] & ~correct[other]
        if not only.any():
            continue
        row = int(only.argmax())
        image, label = only.index[row]
        images, _ = test.batch(torch.tensor([int(image)]))
        shown = {"sharp": (f"test image {image}, {label}", images[0])}
        for lens, (psf, _) in files.items():
            caption = "recognised" if correct[lens].iloc[row] else "not recognised"
            shown[lens] = caption, _single(settings, lens, psf, images, int(image))
        disagreements.append(shown)
    return disagreements


def _single(settings: FramesJob, lens: str, psf: Path, images: Tensor, number: int) -> Tensor:
    """Return the capture (3, H, W) of one image, with its number in the split, at the field of `settings`."""
    grid, light, turns = psf_files.read(psf, "grading")
    k = number % turns
    of_turn = (tensor.chunk(turns)[k][[settings.field]] for tensor in (grid, light))
    camera = PsfCamera.of(settings.captures[lens], *of_turn)
    return camera.all_fields(images, torch.Generator().manual_seed(0))[0, 0]


def draw(
    path: Path,
    title: str,
    frames: Mapping[str, Mapping[str, Tensor]],
    disagreements: Sequence[Mapping[str, tuple[str, Tensor]]],
    rule: str,
) -> None:
    """Draw frames (3, H, W) by name and column with their patches, and single captures below them.

    Args:
        disagreements: captions and single captures by column.
        rule: how the single captures were chosen.
    """
    columns = list(next(iter(frames.values())))
    ratios = [3.2, 2.0] * len(frames) + [2.2] * len(disagreements)
    figure = Figure(figsize=(5.2 * len(columns), 1.02 * sum(ratios)), layout="constrained")
    figure.suptitle(title, weight="bold")
    parts = iter(figure.subfigures(len(ratios), 1, squeeze=False, height_ratios=ratios)[:, 0])
    for name, captures in frames.items():
        for axes, column in zip(next(parts).subplots(1, len(columns)), columns, strict=True):
            _show(axes, captures[column], f"{name}, {column}")
            for row, across, colour in _PATCHES.values():
                top, left = _corner(captures[column], row, across)
                axes.add_patch(Rectangle((left, top), _ZOOM[1], _ZOOM[0], fill=False, edgecolor=colour))
        zoomed = next(parts).subplots(1, 2 * len(columns))
        places = [(column, *patch) for column in columns for patch in _PATCHES.items()]
        for axes, (column, where, (row, across, colour)) in zip(zoomed, places, strict=True):
            top, left = _corner(captures[column], row, across)
            _show(axes, captures[column][:, top : top + _ZOOM[0], left : left + _ZOOM[1]], where)
            axes.spines[:].set_color(colour)
            axes.spines[:].set_linewidth(2)
    for disagreement in disagreements:
        for axes, column in zip(next(parts).subplots(1, len(columns)), columns, strict=True):
            caption, image = disagreement[column]
            _show(axes, image, f"{column}: {caption}")
    figure.supxlabel(rule, fontsize=9)
    save(figure, [path], _DPI)


def _corner(frame: Tensor, row: float, column: float) -> tuple[int, int]:
    """Return the first row and column of a patch centred at a place, or as near as a small frame has it."""
    height, width = frame.shape[1:]
    return max(0, round(row * height) - _ZOOM[0] // 2), max(0, round(column * width) - _ZOOM[1] // 2)


def _show(axes: Axes, image: Tensor, title: str) -> None:
    axes.imshow(image.clamp(0, 1).movedim(0, -1).numpy(), interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
