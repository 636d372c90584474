"""The table of one ablation: accuracies of a design and its variants."""

from pathlib import Path

import pandas

from tasklens.show.publish import publish
from tasklens.study.claims import Claims
from tasklens.study.report import answers_file, verdicts
from tasklens.study.report.measurements import MeasurementFiles, Measurements

_NOTE = """\
Study `{study}`. Difference: accuracy minus that of `{base}` [points], with its 95 % interval over test images{seeds}.
With fewer than {least} seeds, differences are only suggested. A variant that changes the capture is measured with its
own capture."""


def collect(claims: Claims, measurements: Measurements) -> pandas.DataFrame:
    """Return a row for the base lens, then one per variant: accuracy, difference with interval, figures of the lens."""
    differences = verdicts.collect(claims, measurements).set_index("lens")
    classifier = claims.claims[0].classifier
    rows = []
    for lens in (*claims.claims[0].baselines, *differences.index):
        seed_values = [
            measurements.values(lens, classifier, seed) | measurements.lens_values(lens, seed) for seed in claims.seeds
        ]
        measured = pandas.DataFrame(seed_values)
        names = ("accuracy", "corner_accuracy", "accuracy_at_nine", "rms_spot_um", "core_radius_um", "energy_in_window")
        columns = dict.fromkeys((name for name in names if name in measured), "mean")
        rows.append({"lens": lens} | measured.agg(columns | {"worst_margin": "min"}).to_dict())
    at_nine = [name for name in verdicts.AT_NINE if name in differences]
    comparison = differences[["difference", "low", "high", *at_nine, "seeds", "verdict"]].reset_index()
    return pandas.DataFrame(rows).merge(comparison, on="lens", how="left")


def make(settings: Claims, files: MeasurementFiles, csv: Path, md: Path, answers: Path) -> None:
    """Write the table as CSV and Markdown, and the answers from which its intervals can be recomputed."""
    measurements = Measurements.of(settings, files)
    rows = collect(settings, measurements)
    answers_file.write(answers, settings, measurements)
    (base,) = settings.claims[0].baselines
    note = _NOTE.format(
        study=settings.study, base=base, seeds=verdicts.seeds_phrase(settings), least=verdicts.LEAST_SEEDS
    )
    publish(csv, md, rows, "\n".join([note, *verdicts.fitted_lenses(settings, measurements)]))
