"""The tails of all PSFs of a study as one table, and their curves of encircled energy as another."""

from pathlib import Path

import pandas

from tasklens.pipeline.jobs import TailJob
from tasklens.pipeline.layout import Layout
from tasklens.runtime.files import write_text

_NOTE = """\
Study `{study}`. Means over the nine fields, of traced rays about the image point of the chief ray, on which the cached
PSFs are centred (table 1: about the centroid). The core holds 50 % of the launched light; `tail_energy` is the share
outside 3 core radii, `outside_window` that outside the PSF window; the RMS is of the rays that arrive. A sharp core
with a long tail has a large `rms_over_core`: 1 for a disc of even light, 1.20 for a Gaussian spot."""


def collect(job: TailJob, layout: Layout) -> pandas.DataFrame:
    """One row per lens and seed: means over fields, and the ratio of the mean RMS to the mean core radius."""
    rows = []
    for lens in job.lenses:
        for seed in job.seeds:
            fields = pandas.read_csv(layout.tail(lens, seed)).drop(columns="field")
            rows.append({"lens": lens, "seed": seed} | fields.mean(skipna=False).to_dict())
    found = pandas.DataFrame(rows)
    found["rms_over_core"] = found["rms_um"] / found["core_radius_um"]
    return found


def summarise(rows: pandas.DataFrame) -> pandas.DataFrame:
    """One row per lens: means over seeds, with `_std` where several ran."""
    groups = rows.drop(columns="seed").groupby("lens", sort=False)
    table = groups.agg(lambda values: values.mean(skipna=False))
    if rows["seed"].nunique() > 1:
        table = table.join(groups.std(ddof=1).add_suffix("_std"))
    return table.reset_index()


def curves(job: TailJob, layout: Layout) -> pandas.DataFrame:
    """Encircled energy of every lens: lens, seed, field, radius_um, fraction."""
    return pandas.concat(
        [
            pandas.read_csv(layout.encircled_energy(lens, seed)).assign(lens=lens, seed=seed)
            for lens in job.lenses
            for seed in job.seeds
        ]
    )[["lens", "seed", "field", "radius_um", "fraction"]]


def make(job: TailJob, layout: Layout, study: str) -> None:
    """Write the table as CSV and Markdown, and the curves as CSV."""
    table = summarise(collect(job, layout))
    write_text(Path(layout.table("psf_tail", "csv")), table.to_csv(index=False))
    shown = table.copy()
    for name in shown.columns.drop("lens"):
        digits = 3 if name.startswith(("tail", "outside")) else 2
        shown[name] = shown[name].map(lambda v, d=digits: "–" if pandas.isna(v) else f"{v:.{d}f}")
    markdown = shown.to_markdown(index=False, disable_numparse=True)
    note = _NOTE.format(study=study)
    write_text(Path(layout.table("psf_tail", "md")), f"**Tails of the PSFs**\n\n{markdown}\n\n{note}\n")
    write_text(Path(layout.table("encircled_energy", "csv")), curves(job, layout).to_csv(index=False))
