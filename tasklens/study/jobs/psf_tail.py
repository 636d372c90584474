"""Core, tail and encircled energy of the PSFs of all lenses."""

from collections.abc import Sequence
from pathlib import Path

from tasklens.optics.analysis.tail import tail
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import write_rows
from tasklens.study.report import tails
from tasklens.study.report_jobs import TailsJob


def run(
    settings: TailsJob, lenses: Sequence[Path], csv: Path, md: Path, fields_csv: Path, encircled_energy: Path
) -> None:
    """Write the table of tails, its rows by field, and the encircled energy; `lenses` are files of `lens_keys`."""
    by_field, curves = [], []
    for (lens, seed), path in zip(settings.lens_keys, lenses, strict=True):
        view = view_of_spec(settings.specs[lens]).at(settings.fields)
        fields, curve = tail(prescription.read(path)[0].lens, view, settings.rays)
        by_field += [{"lens": lens, "seed": seed} | row for row in fields]
        curves += [{"lens": lens, "seed": seed} | row for row in curve]
    tails.publish_tails(settings.study, by_field, csv, md)
    write_rows(fields_csv, by_field)
    write_rows(encircled_energy, curves)
