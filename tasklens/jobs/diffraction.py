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
    """Write the PSFs at all fields, in the format of the PSFs without diffraction."""
    view = view_of_spec(settings.spec)
    design = prescription.read(lens)[0].lens
    grid = evaluation_psf(design, view, settings.rays, diffraction=True)
    psfs = FieldPsfs(grid, relative_illumination(design, view))
    psf_files.write(psf, psfs, psf_notes(view, grid) | {"diffraction": True})
