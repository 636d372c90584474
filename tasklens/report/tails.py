"""Table of the tails of all PSFs of a study, and of their encircled energy."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import pandas

from tasklens.report.publish import publish, rounded
from tasklens.runtime.files import Files, write_text
from tasklens.study.settings import Slice

_NOTE = """\
Study `{study}`. Means over the nine fields, of traced rays about the image point of the chief ray, on which the cached
PSFs are centred (table 1: about the centroid). The core holds 50 % of the launched light; `tail_energy` is the share
outside 3 core radii, `outside_window` that outside the PSF window; the RMS is of the rays that arrive. A sharp core
with a long tail has a large `rms_over_core`: 1 for a disc of even light, 1.20 for a Gaussian spot."""


ByLens = Mapping[tuple[str, int], Path]  # by (lens, seed)


def collect(contents: Slice, by_field: ByLens) -> pandas.DataFrame:
    """Return a row per lens and seed: means over fields, and the ratio of the mean RMS to the mean core radius."""
    rows = []
    for lens, seed in product(contents.lenses, contents.seeds):
        fields = pandas.read_csv(by_field[lens, seed]).drop(columns="field")
        rows.append({"lens": lens, "seed": seed} | fields.mean(skipna=False).to_dict())
    found = pandas.DataFrame(rows)
    found["rms_over_core"] = found["rms_um"] / found["core_radius_um"]
    return found


def summarise(rows: pandas.DataFrame) -> pandas.DataFrame:
    """Compute a row per lens: means over seeds, with `_std` for several seeds."""
    groups = rows.drop(columns="seed").groupby("lens", sort=False)
    table = groups.mean(skipna=False)
    if rows["seed"].nunique() > 1:
        table = table.join(groups.std(ddof=1).add_suffix("_std"))
    return table.reset_index()


def curves(contents: Slice, encircled_energy: ByLens) -> pandas.DataFrame:
    """Return the encircled energy of every lens: lens, seed, field, radius_um, fraction."""
    pairs = product(contents.lenses, contents.seeds)
    each = [pandas.read_csv(encircled_energy[lens, seed]).assign(lens=lens, seed=seed) for lens, seed in pairs]
    return pandas.concat(each)[["lens", "seed", "field", "radius_um", "fraction"]]


def make(contents: Slice, inputs: Files, outputs: Files) -> None:
    """Write the table as CSV and Markdown, and the curves as CSV."""
    table = summarise(collect(contents, inputs.psf_tail))
    shown = rounded(table, {"": ".2f", "tail": ".3f", "outside": ".3f"})
    publish(outputs, "Tails of the PSFs", table, shown, _NOTE.format(study=contents.study))
    write_text(outputs.encircled_energy, curves(contents, inputs.encircled_energy).to_csv(index=False))
