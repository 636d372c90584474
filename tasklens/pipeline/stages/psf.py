"""PSFs of a lens at all fields, cached for later jobs."""

from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import Files, write_tensors
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the PSFs (F, 3, K, K) float32, with fields, wavelengths, pixel pitch, energies and number of rays."""
    spec = settings.spec
    grid = evaluation_psf(prescription.read(inputs.lens)[0].lens, view_of_spec(spec), settings.rays)
    notes = {
        "fields_mm": spec.fields_mm,
        "wavelengths_um": spec.wavelengths_um,
        "pixel_pitch_um": spec.pixel_pitch_um,
        "energy_inside": grid.sum((-2, -1)).tolist(),
        "rays": settings.rays,
    }
    write_tensors(outputs.psf, {"psf": grid.float()}, notes)
