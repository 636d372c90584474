"""Tables of core, tail and encircled energy of the PSFs of all lenses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas

from tasklens.optics.analysis.tail import tail
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import write_rows
from tasklens.show.publish import publish
from tasklens.study.report_jobs import TailsJob

_NOTE = """\
Study `{study}`. Means over the centres of the cells of the grading, of rays about the image point of the chief ray, on
which PSFs are centred. The core holds 50 % of the light that passes the clear apertures; the tail is outside three core
radii. The RMS spot is about the chief ray (in table 1 about the centroid). A sharp core with a long tail has a large
ratio of RMS to core radius: 1 for a uniform disc, 1.2 for a Gaussian spot."""

Rows = Sequence[Mapping[str, Any]]


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
    publish_tails(settings.study, by_field, csv, md)
    write_rows(fields_csv, by_field)
    write_rows(encircled_energy, curves)


def means(by_field: Rows) -> pandas.DataFrame:
    """Return a row per lens and seed: means over fields, and the ratio of the mean RMS to the mean core radius."""
    lenses = pandas.DataFrame(by_field).drop(columns="field").groupby(["lens", "seed"], sort=False)
    table = lenses.mean(skipna=False).reset_index()
    table["rms_over_core"] = table["rms_chief_ray_um"] / table["core_radius_um"]
    return table


def summarise(rows: pandas.DataFrame) -> pandas.DataFrame:
    """Compute a row per lens: means over seeds, with `_std` for several seeds."""
    groups = rows.drop(columns="seed").groupby("lens", sort=False)
    table = groups.mean(skipna=False)
    if rows["seed"].nunique() > 1:
        table = table.join(groups.std(ddof=1).add_suffix("_std"))
    return table.reset_index()


def publish_tails(study: str, by_field: Rows, csv: Path, md: Path) -> None:
    """Write the table of rows (lens, seed, field, ...) as CSV and Markdown."""
    table = summarise(means(by_field))
    publish(csv, md, table, _NOTE.format(study=study))
