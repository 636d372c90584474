"""Certificate of a lens: figures, aberrations, limits, manufacturability and plots; and its Zemax file."""

from dataclasses import replace
from pathlib import Path

from tasklens.optics.analysis.datasheet import seidel_by_surface
from tasklens.optics.io import prescription
from tasklens.optics.io import zemax as zemax_files
from tasklens.optics.io.spec_section import view_of
from tasklens.optics.tolerancing.manufacturing_errors import errors
from tasklens.optics.tolerancing.sensitivity import displacements
from tasklens.runtime.files import write_text
from tasklens.settings.tolerance_settings import Grade
from tasklens.show import certificate, figures
from tasklens.show.panel import Panel

_RAYS = 256  # per field and colour, for sensitivities


def run(
    name: str,
    seed: int,
    grade: Grade,
    lens: Path,
    psf: Path,
    page: Path,
    zemax: Path,
    catalogue: Path,
    section: Path,
    spots: Path,
    psfs: Path,
    curves: Path,
) -> None:
    """Write the page and the Zemax file, and draw the panels of the lens figure."""
    lens_prescription, content = prescription.read(lens)
    design = lens_prescription.lens
    view = view_of(design, content, str(lens))
    title = f"{name}, seed {seed}"
    text = certificate.markdown(title, view.fields.tolist(), content, seidel_by_surface(design, view))
    tolerances = errors(design, grade)
    displacements_um = displacements(design, view, tolerances, _RAYS).tolist()
    errors_um = {error.name: um for error, um in zip(tolerances, displacements_um, strict=True)}
    limits = certificate.manufacturability(
        content["margins"], certificate.shapes(design), errors_um, grade.name, view.pixel_pitch_um
    )
    write_text(page, f"{text}\n{limits}")
    zemax_files.write(zemax, replace(prescription.with_system_data(lens_prescription, view), title=name, aperture=None))
    catalogue.touch()  # already written if the lens has a glass of its own
    figures.draw_parts(Panel.read(name, lens, psf), section, spots, psfs, curves)
