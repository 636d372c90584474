"""Drawings of lenses that have no files of a study: their figures and PSFs are computed."""

from collections.abc import Mapping
from pathlib import Path

from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.spots import clear_semi_diameters, evaluation_psf
from tasklens.optics.apertures import with_clear_apertures
from tasklens.optics.io.lens_files import LensFile
from tasklens.report.figures import Panel, panel_of
from tasklens.report.figures import draw as draw_panels
from tasklens.runtime.errors import InputError

_RIM = 1.02  # of a surface without clear aperture, over the radius that light uses
_FIELDS, _COLOURS = 9, 3  # that a panel shows some of


def draw(path: Path, lenses: Mapping[str, LensFile], rays: int) -> None:
    """Draw lenses by their titles one above the other; the suffix of `path` is the format.

    Raises:
        InputError: a lens whose specification has not nine fields and three colours.
    """
    draw_panels([path], [_panel(title, found, rays) for title, found in lenses.items()])


def _panel(title: str, found: LensFile, rays: int) -> Panel:
    view, lens = found.view, found.lens
    fields, colours = len(view.fields), len(view.wavelengths)
    if (fields, colours) != (_FIELDS, _COLOURS):
        raise InputError(f"{title}: a drawing needs nine fields and three colours, found {fields} and {colours}")
    lens = with_clear_apertures(lens, _RIM * clear_semi_diameters(lens, view))
    return panel_of(title, lens, view, evaluation_psf(lens, view, rays).float(), figures(lens, view, rays))
