"""Core, tail and encircled energy of the PSFs of a lens."""

from tasklens.optics.analysis.tail import tail
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import Files, write_rows
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the tables of tails and of encircled energy."""
    lens = prescription.read(inputs.lens)[0].lens
    by_field, curve = tail(lens, view_of_spec(settings.spec), settings.rays)
    write_rows(outputs.psf_tail, by_field)
    write_rows(outputs.encircled_energy, curve)
