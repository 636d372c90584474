"""Figure of whole frames: an image and its captures through some lenses, with zoomed patches and answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from tasklens.show.figures import save

_ZOOM = 96, 144  # height and width of a zoomed patch [pixels]
# Centre of each patch [share of the height, share of the width], and its colour.
_PATCHES = {"centre": (0.5, 0.5, "#0072B2"), "off axis": (0.81, 0.81, "#D55E00")}
_DPI = 130


@dataclass(frozen=True)
class ClassifiedImage:
    """A test image, and whether the network of each lens recognises it.

    Attributes:
        title: description of the image.
        shown: images (3, H, W) by column: the sharp image, and the captures of the lenses at one field.
        correct: whether each capture is recognised, by column.
    """

    title: str
    shown: Mapping[str, Tensor]
    correct: Mapping[str, bool]

    def caption(self, column: str) -> str:
        """Return the words above the image of a column."""
        if column not in self.correct:
            return self.title
        return "recognised" if self.correct[column] else "not recognised"


def draw(
    path: Path, title: str, frames: Mapping[str, Mapping[str, Tensor]], answered: Sequence[ClassifiedImage], rule: str
) -> None:
    """Draw frames (3, H, W) by name and column with their patches, and single captures below them.

    Args:
        rule: how the single captures were chosen.
    """
    columns = list(next(iter(frames.values())))
    ratios = [3.2, 2.0] * len(frames) + [2.2] * len(answered)
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
    for entry in answered:
        for axes, column in zip(next(parts).subplots(1, len(columns)), columns, strict=True):
            _show(axes, entry.shown[column], f"{column}: {entry.caption(column)}")
    figure.supxlabel(rule, fontsize=9)
    save(figure, [path], _DPI)


def _corner(frame: Tensor, row: float, column: float) -> tuple[int, int]:
    """Return the first row and column of a patch centred at a place."""
    height, width = frame.shape[1:]
    return round(row * height) - _ZOOM[0] // 2, round(column * width) - _ZOOM[1] // 2


def _show(axes: Axes, image: Tensor, title: str) -> None:
    axes.imshow(image.clamp(0, 1).movedim(0, -1).numpy(), interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
