"""Figures of lenses: cross-section, spots, PSFs, ray fans, MTF and encircled energy from axis to corner.

All panels about the sensor have the same axes, x to the right and y upward, and are centred on the image point of the
chief ray. Colours are those of Okabe and Ito, which colour-blind readers can tell apart; lines also differ in
their dashes.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import torch
from matplotlib.figure import Figure, SubFigure
from matplotlib.transforms import Bbox
from torch import Tensor

from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, lit_semi_diameters, ray_fans, spot_diagram, trace_fields
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.runtime.files import replacing
from tasklens.show import curves, spot_panels, vector_files
from tasklens.show.along_field import along_field
from tasklens.show.cross_section import cross_section

_RAYS = 4096  # per field and wavelength
_FANS = 41
_RIM = 1.02  # drawn radius of a surface, as a multiple of the illuminated radius
_SHOWN = 0.95  # fraction of the rays of a spot that is drawn at least
_DPI = 110
_PLACES = 6  # decimals of a position in a figure
_NIGHT: Any = {"figure.facecolor": "black"} | dict.fromkeys(
    ("text.color", "axes.labelcolor", "axes.edgecolor"), "white"
)


@dataclass(frozen=True)
class Panel:
    """Contents of the figure of one lens.

    Attributes:
        title: title of the figure.
        lens: lens with finite clear apertures.
        view: fields, wavelengths and pixels.
        psf: (F, 3, K, K) cached PSFs.
        figures: optical figures of the lens, for captions.
        rays: rays of all fields on the image plane.
        centre: (F, 2) image points of the chief rays [mm].
        narrowest_mm: length of the shortest lens of the figure; its scale bars fit.
        narrowest_um: width of the smallest PSF window of the figure.
        half_um: largest ray error that spots and ray fans show; None: half of the PSF window.
    """

    title: str
    lens: Lens
    view: View
    psf: Tensor
    figures: Mapping
    rays: Rays
    centre: Tensor
    narrowest_mm: float = math.inf
    narrowest_um: float = math.inf
    half_um: float | None = None

    @property
    def shown_um(self) -> float:
        """Largest ray error that spots and ray fans show."""
        return self.half_um or self.view.kernel_size * self.view.pixel_pitch_um / 2

    @property
    def field_names(self) -> dict[int, str]:
        """Names by index of the drawn fields: nearest to the axis, in the middle, and in the corner."""
        return shown_fields(self.view)


def shown_fields(view: View) -> dict[int, str]:
    """Return the names by index of the fields nearest to the axis, in the middle, and in the corner."""
    names = view.named_fields
    return {field: name for name, field in names.items()} | {names["axis"]: "axis"}


def panel(title: str, path: Path, psf: Path) -> Panel:
    """Read the panel of a lens from the files of the lens and its PSFs; raises FileError."""
    prescribed, content = prescription.read(path)
    view = view_of(prescribed.lens, content, str(path))
    return panel_of(title, prescribed.lens, view, psf_files.read(psf, "nine").psf, content["figures"])


def panel_of(title: str, lens: Lens, view: View, psf: Tensor, figures: Mapping) -> Panel:
    """Return the panel of a lens with its PSFs and figures."""
    rays = trace_fields(lens, view, sobol_disc(_RAYS, 0))
    return Panel(title, lens, view, psf, figures, rays, chief_points(lens, view))


def figure_of(panels: Sequence[Panel]) -> Figure:
    """Return the figure of one lens, or of several one above the other."""
    mm = min(float(panel.lens.thickness.sum()) for panel in panels)
    um = min(panel.view.kernel_size * panel.view.pixel_pitch_um for panel in panels)
    half_um = _round_up(max(_spread_um(panel) for panel in panels))
    panels = [replace(panel, narrowest_mm=mm, narrowest_um=um, half_um=half_um) for panel in panels]
    whole = Figure(figsize=(13, 11.5 * len(panels)), layout="constrained")
    for part, panel in zip(whole.subfigures(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        _draw(part, panel)
    return whole


def _spread_um(panel: Panel) -> float:
    """Return the distance from the chief ray within which most rays of the drawn fields arrive [um]."""
    fields = list(panel.field_names)
    distance = spot_diagram(panel.rays, panel.centre)[fields].norm(dim=-1)
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
    rows = part.subfigures(4, 1, squeeze=False, height_ratios=(4, 2.5, 2.5, 2.5))[:, 0]
    top, middle, bottom, foot = rows
    left, right = top.subfigures(1, 2, width_ratios=(1.1, 1))
    draw_section(left, panel)
    draw_spots(right, panel)
    draw_psfs(middle, panel)
    fans, charts = bottom.subfigures(1, 2, width_ratios=(1.1, 1))
    curves.ray_fans(fans, ray_fans(panel.lens, panel.view, _FANS), panel.view, panel.field_names, panel.shown_um)
    draw_curves(charts, panel)
    draw_by_field(foot, panel)
    figures = panel.figures
    near = f", object at {figures['object_distance_mm']:g} mm" if "object_distance_mm" in figures else ""
    part.suptitle(f"{panel.title}: EFL {figures['efl_mm']:.3f} mm, F/{figures['f_number']:.2f}{near}", weight="bold")


def section_svg(lens: Lens, view: View) -> str:
    """Return the cross-section of a lens with rays as SVG; surfaces end just beyond the illuminated radius."""
    figure, text = Figure(figsize=(7, 4), layout="constrained"), io.StringIO()
    used = torch.minimum(lens.semi_diameter, _RIM * lit_semi_diameters(lens, view))
    lens = replace(lens, semi_diameter=torch.where(used > 0, used, lens.semi_diameter))
    cross_section(figure.subplots(), lens, view, shown_fields(view))
    with matplotlib.rc_context(vector_files.STYLE):
        figure.savefig(text, format="svg", metadata=vector_files.METADATA["svg"])
    return text.getvalue()


def draw_section(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the cross-section with rays."""
    cross_section(part.subplots(), panel.lens, panel.view, panel.field_names, panel.narrowest_mm)


def draw_spots(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the spot diagrams of axis, middle and corner, with the circles of core and 80 %."""
    spot_panels.spots(part, panel.rays, panel.centre, panel.view, panel.figures, panel.field_names, panel.shown_um)


def draw_psfs(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the PSFs of all fields, on square-root and logarithmic scales."""
    spot_panels.psf_strip(part, panel.psf, panel.view, panel.figures, panel.narrowest_um)


def draw_curves(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw MTF and encircled energy of axis, middle and corner."""
    mtf, energy = part.subplots(1, 2)
    curves.mtf(mtf, panel.rays, panel.view, panel.figures, panel.field_names)
    curves.encircled(energy, panel.rays, panel.centre, panel.view, panel.field_names)


def draw_by_field(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw MTF against field and focus, field curvature and distortion."""
    by_field, by_focus, curvature, distortion = part.subplots(1, 4)
    view, frequency = panel.view, panel.figures["nyquist_per_mm"] / 2
    along = along_field(panel.lens, view)
    curves.mtf_by_field(by_field, along, frequency)
    curves.mtf_by_focus(by_focus, panel.rays, view, panel.figures, frequency, panel.field_names)
    curves.focus_by_field(curvature, along)
    curves.distortion_by_field(distortion, along)


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
        (draw_spots, spots, (9, 4.2)),  # titles would be cut off if it were lower
        (draw_psfs, psfs, (13, 3.2)),
        (draw_curves, charts, (9, 3.8)),
    )
    for function, path, size in parts:
        with matplotlib.rc_context(_NIGHT if function is draw_psfs else {}):
            figure = Figure(figsize=size, layout="constrained")
            function(figure, panel)
            save(figure, [path])
