"""Core, tail and encircled energy of the PSFs of all lenses."""

from itertools import product

from tasklens.optics.analysis.tail import tail
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.report import tails
from tasklens.runtime.files import Files
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the table of tails, its rows by field, and the encircled energy."""
    by_field, curves = [], []
    for lens, seed in product(settings.lenses, settings.seeds):
        found = prescription.read(inputs.lenses[lens, seed])[0].lens
        fields, curve = tail(found, view_of_spec(settings.specs[lens]), settings.rays)
        by_field += [{"lens": lens, "seed": seed} | row for row in fields]
        curves += [{"lens": lens, "seed": seed} | row for row in curve]
    tails.publish_tails(settings.study, by_field, curves, outputs)
