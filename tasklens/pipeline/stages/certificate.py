"""The certificate of a lens: figures, aberrations, limits and manufacturability; its drawings, and its Zemax file."""

from dataclasses import replace

from tasklens.optics.analysis.datasheet import seidel_by_surface, view_of
from tasklens.optics.analysis.shapes import shapes
from tasklens.optics.io import prescription, zemax
from tasklens.optics.tolerancing.errors import errors
from tasklens.optics.tolerancing.sensitivity import displacements
from tasklens.report import certificate, figures, manufacturability
from tasklens.runtime.files import Files, write_text
from tasklens.study.settings import Slice

_RAYS = 256  # per field and colour, of sensitivities


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the page and the Zemax file, and draw the lens: as one figure, and in parts."""
    found, content = prescription.read(inputs.lens)
    lens = found.lens
    view = view_of(lens, content, str(inputs.lens))
    title = f"{settings.lens}, seed {settings.seed}"
    page = certificate.markdown(title, view.fields.tolist(), content, seidel_by_surface(lens, view))
    allowed = errors(lens, settings.grade)
    moved_um = displacements(lens, view, allowed, _RAYS).tolist()
    errors_um = {error.name: um for error, um in zip(allowed, moved_um, strict=True)}
    section = manufacturability.markdown(
        content["margins"], shapes(lens), errors_um, settings.grade.name, view.pixel_pitch
    )
    write_text(outputs.page, f"{page}\n{section}")
    zemax.write(outputs.zemax, replace(prescription.with_use(found, view), title=settings.lens, aperture=None))
    panel = figures.panel(settings.lens, inputs.lens, inputs.psf)
    figures.draw([outputs.figure, outputs.figure_svg, outputs.figure_pdf], [panel])
    figures.draw_parts(panel, outputs.section, outputs.spots, outputs.psfs, outputs.curves)
