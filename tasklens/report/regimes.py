"""Gain of task-driven design over the best imaging lens, by element counts and specifications."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean

import pandas

from tasklens.materials.material import AIR
from tasklens.report import verdicts
from tasklens.report.measurements import Measurements
from tasklens.report.publish import publish
from tasklens.study.claims import Claims
from tasklens.study.report_jobs import RegimesJob

_NOTE = """\
Study `{study}`. Accuracy of the task-driven lens minus that of the best imaging lens, chosen for each seed by minival
accuracy, with its 95 % interval. A difference is undecided if it is not significant at 5 % after Holm's correction
for all rows; fewer than five seeds only suggest it. RMS spots and numbers of evaluations are means over seeds; the
lenses from which the start was chosen are included (times: target `effort`)."""


def collect(claims: Claims, tried: Mapping[str, int], measurements: Measurements) -> pandas.DataFrame:
    """Return a row per task-driven lens: specification, difference [points] with interval, RMS spots [um], effort.

    Args:
        tried: number of lens evaluations of each design.
    """
    rows = verdicts.collect(claims, measurements)
    lens_pairs = [
        [(claim.lens, measurements.strongest_baseline(claim, seed), seed) for seed in claims.seeds]
        for claim in claims.claims
    ]

    def rms_um(lens: str, seed: int) -> float:
        return measurements.lens_values(lens, seed)["rms_spot_um"]

    files = [measurements.lens_file(lens, claims.seeds[0]) for lens in rows["lens"]]
    specs = [content["spec"] for content in files]
    return pandas.DataFrame(
        {
            "elements": rows["lens"].str.split("-").str[0],
            "design": rows["lens"].str.split("-").str[1],
            "element_count": [
                sum(surface["medium"] != AIR.name for surface in content["surfaces"]) for content in files
            ],
            "field_of_view_deg": [spec["field_of_view_deg"] for spec in specs],
            "f_number": [spec["f_number"] for spec in specs],
            "difference": rows["difference"],
            "low": rows["low"],
            "high": rows["high"],
            "rms_spot_um_task": [mean(rms_um(task_lens, seed) for task_lens, _, seed in pairs) for pairs in lens_pairs],
            "rms_spot_um_imaging": [
                mean(rms_um(baseline, seed) for _, baseline, seed in pairs) for pairs in lens_pairs
            ],
            "evaluations_task": [round(mean(tried[task_lens] for task_lens, _, _ in pairs)) for pairs in lens_pairs],
            "evaluations_imaging": [round(mean(tried[baseline] for _, baseline, _ in pairs)) for pairs in lens_pairs],
            "baseline": rows["baseline"],
            "seeds": rows["seeds"],
            "verdict": rows["verdict"],
        }
    )


def make(
    settings: RegimesJob,
    lenses: Sequence[Path],
    metrics: Sequence[Path],
    predictions: Sequence[Path],
    csv: Path,
    md: Path,
) -> None:
    """Write the table as CSV and Markdown."""
    claims = settings.claims
    rows = collect(claims, settings.tried, Measurements.of_claims(claims, lenses, metrics, predictions))
    publish(csv, md, "Where it pays", rows, _NOTE.format(study=claims.study))
