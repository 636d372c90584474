"""PSFs of a lens with diffraction."""

from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import Files, write_tensors
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the PSFs at all fields, as the design does those without diffraction."""
    view = view_of_spec(settings.spec)
    grid = evaluation_psf(prescription.read(inputs.lens)[0].lens, view, settings.rays, diffraction=True)
    write_tensors(outputs.psf, {"psf": grid.float()}, psf_notes(view, grid) | {"diffraction": True})
