"""Table of the tails of all PSFs of a study, and of their encircled energy."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas

from tasklens.show.publish import publish

_NOTE = """\
Study `{study}`. Means over the centres of the cells of the grading, of rays about the image point of the chief ray, on
which PSFs are centred. The core holds 50 % of the light that passes the clear apertures; the tail is outside three core
radii. The RMS spot is about the chief ray (in table 1 about the centroid). A sharp core with a long tail has a large
ratio of RMS to core radius: 1 for a uniform disc, 1.2 for a Gaussian spot."""


Rows = Sequence[Mapping[str, Any]]


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
    publish(csv, md, "Tails of the PSFs", table, _NOTE.format(study=study))
