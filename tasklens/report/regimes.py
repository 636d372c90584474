"""Where task-driven design pays: its difference to the best imaging lens over element counts and specifications."""

from pathlib import Path
from statistics import mean

import pandas

from tasklens.pipeline.layout import Layout
from tasklens.report import verdicts
from tasklens.report.tables import lens_file, lens_values
from tasklens.runtime.files import write_text
from tasklens.study.claims import VerdictsJob

_NOTE = """\
Study `{study}`. Accuracy of the task-driven lens less that of the best imaging lens of the seed by minival [points],
its 95 % interval, and the mean RMS spots of the two [um]. A difference whose interval holds zero, or of fewer than
five seeds, is undecided."""


def collect(job: VerdictsJob, layout: Layout) -> pandas.DataFrame:
    """A row per task-driven lens: elements, field of view, F-number, difference [points] with interval, RMS spots [um].

    Raises:
        FileNotFoundError: a lens or a measurement is missing.
    """
    rows = verdicts.collect(job, layout)

    def rms_um(lens: str, seed: int) -> float:
        return lens_values(Path(layout.lens(lens, seed)))["rms_spot_um"]

    specs = [lens_file(Path(layout.lens(lens, job.seeds[0])))["spec"] for lens in rows["lens"]]
    return pandas.DataFrame(
        {
            "elements": rows["lens"].str.partition("-")[0],
            "field_of_view_deg": [spec["field_of_view_deg"] for spec in specs],
            "f_number": [spec["f_number"] for spec in specs],
            "difference": rows["difference"],
            "low": rows["low"],
            "high": rows["high"],
            "rms_task_um": [mean(rms_um(claim.lens, seed) for seed in job.seeds) for claim in job.claims],
            "rms_imaging_um": [
                mean(rms_um(verdicts.opponent(claim, seed, layout), seed) for seed in job.seeds) for claim in job.claims
            ],
            "opponent": rows["opponent"],
            "seeds": rows["seeds"],
            "verdict": rows["verdict"],
        }
    )


def make(job: VerdictsJob, layout: Layout, study: str) -> None:
    """Write the map as CSV and Markdown."""
    rows = collect(job, layout)
    write_text(Path(layout.table("regimes", "csv")), rows.to_csv(index=False))
    signed, plain = dict.fromkeys(("difference", "low", "high"), "{:+.2f}"), "{:.1f}"
    digits = signed | {"rms_task_um": plain, "rms_imaging_um": plain}
    shown = rows.assign(**{name: rows[name].map(form.format) for name, form in digits.items()})
    table = shown.to_markdown(index=False, disable_numparse=True)
    write_text(Path(layout.table("regimes", "md")), f"**Where it pays**\n\n{table}\n\n{_NOTE.format(study=study)}\n")
