"""The table of one ablation: a design and its variants, with what each changes in accuracy."""

from pathlib import Path

import pandas

from tasklens.pipeline.layout import Layout
from tasklens.report import verdicts
from tasklens.report.tables import lens_values, measured_values
from tasklens.runtime.files import write_text
from tasklens.study.claims import AblationJob

_NOTE = """\
Study `{study}`. Difference: accuracy less that of `{base}` [points], with its 95 % interval over test pictures{seeds};
with fewer than {least} seeds it is undecided, whatever its interval. A variant of the capture is also measured with
its capture."""


def collect(job: AblationJob, layout: Layout) -> pandas.DataFrame:
    """A row for the design that is varied, then one per variant: accuracy, difference with interval, the lens' figures.

    Raises:
        FileNotFoundError: a lens or a measurement is missing.
    """
    differences = verdicts.collect(job.verdicts, layout).set_index("lens")
    seeds, classifier = job.verdicts.seeds, job.verdicts.claims[0].classifier
    rows = []
    for lens in (job.base, *differences.index):
        measured = [
            measured_values(Path(layout.metrics(lens, seed, classifier))) | lens_values(Path(layout.lens(lens, seed)))
            for seed in seeds
        ]
        means = pandas.DataFrame(measured).mean()
        columns = ["rms_spot_um", "core_radius_um", "energy_in_window", "worst_margin"]
        rows.append({"lens": lens, "accuracy": means["accuracy"]} | means[columns].to_dict())
    compared = differences[["difference", "low", "high", "seeds", "verdict"]].reset_index()
    return pandas.DataFrame(rows).merge(compared, on="lens", how="left")


def make(job: AblationJob, layout: Layout, study: str) -> None:
    """Write the table as CSV and Markdown."""
    rows = collect(job, layout)
    write_text(Path(layout.ablation(job.name, "csv")), rows.to_csv(index=False))
    digits = dict.fromkeys(("difference", "low", "high"), "{:+.2f}")
    digits |= dict.fromkeys(("accuracy", "rms_spot_um", "core_radius_um"), "{:.2f}")
    digits |= dict.fromkeys(("energy_in_window", "worst_margin"), "{:.3f}") | {"seeds": "{:.0f}"}
    shown = rows.assign(**{name: rows[name].map(form.format, na_action="ignore") for name, form in digits.items()})
    table = shown.fillna("–").to_markdown(index=False, disable_numparse=True)
    several = " and seeds" if len(job.verdicts.seeds) > 1 else ""
    note = _NOTE.format(study=study, base=job.base, seeds=several, least=verdicts.LEAST_SEEDS)
    write_text(Path(layout.ablation(job.name, "md")), f"**Ablation: {job.name}**\n\n{table}\n\n{note}\n")
