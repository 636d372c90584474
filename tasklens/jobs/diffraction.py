"""PSFs of a lens with diffraction."""

from pathlib import Path

from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import view_of_spec
from tasklens.study.job_settings import DiffractionJob


def run(settings: DiffractionJob, lens: Path, psf: Path) -> None:
    """Write the PSFs at all fields, as the design does those without diffraction."""
    view = view_of_spec(settings.spec)
    designed = prescription.read(lens)[0].lens
    grid = evaluation_psf(designed, view, settings.rays, diffraction=True)
    psfs = FieldPsfs(grid, relative_illumination(designed, view))
    psf_files.write(psf, psfs, psf_notes(view, grid) | {"diffraction": True})
