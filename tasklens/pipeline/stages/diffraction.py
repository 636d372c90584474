"""PSFs of a lens with diffraction."""

from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import Files
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the PSFs at all fields, as the design does those without diffraction."""
    view = view_of_spec(settings.spec)
    lens = prescription.read(inputs.lens)[0].lens
    grid = evaluation_psf(lens, view, settings.rays, diffraction=True)
    found = FieldPsfs(grid, relative_illumination(lens, view))
    psf_files.write(outputs.psf, found, psf_notes(view, grid) | {"diffraction": True})
