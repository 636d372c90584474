"""Figures of lenses: cross-section, spots, PSFs, ray fans, MTF and encircled energy from axis to corner.

All panels about the sensor have the same axes, x to the right and y upward, and are centred on the image point of the
chief ray.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import torch
from matplotlib.figure import Figure, SubFigure
from matplotlib.transforms import Bbox

from tasklens.optics.analysis.spots import lit_semi_diameters, spot_diagram
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.files import replacing
from tasklens.show import vector_files
from tasklens.show.cross_section import cross_section
from tasklens.show.curves import draw_curves, draw_focus, draw_ray_fans, draw_sharpness
from tasklens.show.panel import RIM, Panel
from tasklens.show.spot_panels import draw_psfs, draw_spots

_SHOWN = 0.95  # fraction of the rays of a spot that is drawn at least
_DPI, _NOTEBOOK_DPI = 110, 80
_PLACES = 6  # decimals of a position in a figure
_NIGHT: Any = {"figure.facecolor": "black"} | dict.fromkeys(
    ("text.color", "axes.labelcolor", "axes.edgecolor"), "white"
)


class NotebookFigure(Figure):
    """A figure that a notebook displays without pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=_NOTEBOOK_DPI)
        return stream.getvalue()


def figure_of(panels: Sequence[Panel]) -> NotebookFigure:
    """Return the figure of one lens, or of several one above the other."""
    mm = min(float(panel.lens.thickness.sum()) for panel in panels)
    um = min(panel.view.kernel_size * panel.view.pixel_pitch_um for panel in panels)
    half_um = _round_up(max(_spread_um(panel) for panel in panels))
    panels = [replace(panel, narrowest_mm=mm, narrowest_um=um, half_um=half_um) for panel in panels]
    whole = NotebookFigure(figsize=(13, 13.7 * len(panels)), layout="constrained")
    for part, panel in zip(whole.subfigures(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        _draw(part, panel)
    return whole


def _spread_um(panel: Panel) -> float:
    """Return the distance from the chief ray within which most rays of all fields arrive [um]."""
    distance = spot_diagram(panel.rays, panel.centre).norm(dim=-1)
    distance = distance[distance.isfinite()]
    return 1e3 * float(distance.quantile(_SHOWN)) if len(distance) else panel.shown_um


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-3)))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * (1 - 1e-9))


def save(figure: Figure, paths: Sequence[Path], dpi: int = _DPI) -> None:
    """Write a figure in the format of each path's suffix: png, svg, pdf or webp."""
    figure.set_dpi(dpi)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
        _round(figure)
    with matplotlib.rc_context(vector_files.STYLE):
        for path in paths:
            kind = path.suffix.removeprefix(".")
            with replacing(path) as temporary:
                figure.savefig(temporary, dpi=dpi, format=kind, metadata=vector_files.METADATA.get(kind))


def _round(part: Figure | SubFigure) -> None:
    """Round the positions of all parts: their last digits differ between runs, and files must not."""
    for inner in part.subfigs:
        inner.bbox_relative.set_points(inner.bbox_relative.get_points().round(_PLACES) + 0.0)  # no -0.0
        _round(inner)
    for axes in part.axes if not part.subfigs else ():
        axes.set_position(Bbox(axes.get_position(original=True).get_points().round(_PLACES) + 0.0))


def _draw(part: SubFigure, panel: Panel) -> None:
    rows = part.subfigures(5, 1, squeeze=False, height_ratios=(4, 2.2, 2.5, 2.5, 2.5))[:, 0]
    for row, functions, widths in zip(
        rows,
        ((draw_section, draw_sharpness), (draw_spots,), (draw_psfs,), (draw_ray_fans, draw_curves), (draw_focus,)),
        ((1.1, 1), (1,), (1,), (1.1, 1), (1,)),
        strict=True,
    ):
        for inner, function in zip(
            row.subfigures(1, len(functions), squeeze=False, width_ratios=widths)[0], functions, strict=True
        ):
            function(inner, panel)
    figures = panel.figures
    near = f", object at {figures['object_distance_mm']:g} mm" if "object_distance_mm" in figures else ""
    part.suptitle(f"{panel.title}: EFL {figures['efl_mm']:.3f} mm, F/{figures['f_number']:.2f}{near}", weight="bold")


def section_svg(lens: Lens, view: View) -> str:
    """Return the cross-section of a lens with rays as SVG; surfaces end just beyond the illuminated radius."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    used = torch.minimum(lens.semi_diameter, RIM * lit_semi_diameters(lens, view))
    lens = replace(lens, semi_diameter=torch.where(used > 0, used, lens.semi_diameter))
    cross_section(figure.subplots(), lens, view)
    return vector_files.svg(figure)


def draw_section(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the cross-section with rays."""
    cross_section(part.subplots(), panel.lens, panel.view, panel.narrowest_mm)


def compare_psfs(path: Path, panels: Sequence[Panel]) -> None:
    """Draw the PSFs of lenses one above the other."""
    with matplotlib.rc_context(_NIGHT):
        figure = Figure(figsize=(13, 3.2 * len(panels)), layout="constrained")
        for part, panel in zip(figure.subfigures(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
            draw_psfs(part, panel)
            part.suptitle(panel.title, weight="bold")
        save(figure, [path])


def draw_parts(panel: Panel, section: Path, spots: Path, psfs: Path, charts: Path) -> None:
    """Write the parts of the figure of a lens as separate files, for a page."""
    parts = (
        (draw_section, section, (5.2, 3.4)),
        (draw_spots, spots, (13, 2.6)),
        (draw_psfs, psfs, (13, 3.2)),
        (draw_curves, charts, (9, 3.8)),
    )
    for function, path, size in parts:
        with matplotlib.rc_context(_NIGHT if function is draw_psfs else {}):
            figure = Figure(figsize=size, layout="constrained")
            function(figure, panel)
            save(figure, [path])
