"""Gain of task-driven design over the best imaging lens, by element counts and specifications."""

from statistics import mean

import pandas

from tasklens.materials.material import AIR
from tasklens.report import verdicts
from tasklens.report.measurements import Measurements
from tasklens.report.publish import publish, rounded
from tasklens.runtime.files import Files
from tasklens.study.claims import Claims

_NOTE = """\
Study `{study}`. Accuracy of the task-driven lens less that of the best imaging lens of the seed by minival [points],
its 95 % interval, and the mean RMS spots of the two [um]. A difference is undecided that is not significant at 5 %
after Holm's correction for all rows; fewer than five seeds only suggest it."""


def collect(claims: Claims, measurements: Measurements) -> pandas.DataFrame:
    """Return a row per task-driven lens: specification, difference [points] with interval, RMS spots [um]."""
    rows = verdicts.collect(claims, measurements)

    def rms_um(lens: str, seed: int) -> float:
        return measurements.lens_values(lens, seed)["rms_spot_um"]

    files = [measurements.lens_file(lens, claims.seeds[0]) for lens in rows["lens"]]
    specs = [content["spec"] for content in files]
    return pandas.DataFrame(
        {
            "elements": rows["lens"].str.split("-").str[0],
            "design": rows["lens"].str.split("-").str[1],
            "plastics": [sum(each["medium"] != AIR.name for each in content["surfaces"]) for content in files],
            "field_of_view_deg": [spec["field_of_view_deg"] for spec in specs],
            "f_number": [spec["f_number"] for spec in specs],
            "difference": rows["difference"],
            "low": rows["low"],
            "high": rows["high"],
            "rms_task_um": [mean(rms_um(claim.lens, seed) for seed in claims.seeds) for claim in claims.claims],
            "rms_imaging_um": [
                mean(rms_um(measurements.strongest_baseline(claim, seed), seed) for seed in claims.seeds)
                for claim in claims.claims
            ],
            "baseline": rows["baseline"],
            "seeds": rows["seeds"],
            "verdict": rows["verdict"],
        }
    )


def make(claims: Claims, inputs: Files, outputs: Files) -> None:
    """Write the table as CSV and Markdown."""
    rows = collect(claims, Measurements(inputs.lenses, inputs.metrics, inputs.predictions))
    shown = rounded(rows, dict.fromkeys(("difference", "low", "high"), "+.2f") | {"rms": ".1f"})
    publish(outputs, "Where it pays", rows, shown, _NOTE.format(study=claims.study))
