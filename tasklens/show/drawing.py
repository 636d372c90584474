"""Drawings of lenses without study files; figures and PSFs are computed."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.spots import evaluation_psf, lit_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.show.figures import Panel, figure_of, panel_of

_RIM = 1.02  # radius of a surface without clear aperture, as a multiple of the illuminated radius
_COLOURS = 3  # most wavelengths that a panel can show


def figure(lenses: Mapping[str, tuple[Lens, View]], rays: int) -> Figure:
    """Return a figure of lenses (by title), one above the other."""
    return figure_of([_panel(title, *pair, rays) for title, pair in lenses.items()])


def _panel(title: str, lens: Lens, view: View, rays: int) -> Panel:
    lens = lens.detached()
    psf = evaluation_psf(lens, view.in_colours(), rays).float()
    lens_figures = figures(lens, view, rays)
    view = view if len(view.wavelengths_um) < _COLOURS else view.in_colours()
    lens = lens.with_clear_apertures(_RIM * lit_semi_diameters(lens, view))
    return panel_of(title, lens, view, psf, lens_figures)
