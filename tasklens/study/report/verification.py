"""Verification of a finished study: limits and optima of the lenses, and reproduced accuracies.

All test images are classified again with the stored weights and the cached PSFs (stage `reproduce`, a job per
measurement). The new predictions are compared with the predictions and metrics of fine-tuning, and with the tables.
"""

import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas

from tasklens.runtime.files import read_table
from tasklens.settings import names
from tasklens.settings.names import SHARP
from tasklens.show import predictions
from tasklens.show.optimality import optimum
from tasklens.study.report.measurements import MeasurementFiles, Measurements
from tasklens.study.table_contents import MeasuredKey, TableContents, VerificationContents

ROUNDING = 1e-6  # tolerance on margins [mm or a fraction]
DIFFERENT = 1e-3  # largest fraction of captures classified differently; on the same machine it is zero


def verify(
    contents: VerificationContents,
    measurements: Measurements,
    reproduced: Mapping[MeasuredKey, Path],
    tables: Mapping[str, Path],
) -> tuple[list[str], list[str]]:
    """Check every lens, measurement and table of a study; a failure does not stop the checks.

    Args:
        reproduced: files of the predictions reproduced with the stored weights.
        tables: CSV files by name of the table.

    Returns:
        Failures, and violated limits of unconstrained lenses: each with lens, seed, limit, and the actual value.
    """
    failures: list[str] = []
    unconstrained: list[str] = []
    for lens, seed in product(contents.lenses, contents.seeds):
        content = measurements.lens_file(lens, seed)
        violations = violated_limits(content, contents.efl_mm[lens], contents.efl_tolerance)
        problems = [f"{limit}: margin {value:.4g}" for limit, value in violations.items()]
        if "diverged" in content.get("origin", {}):
            problems.append(f"diverged: {content['origin']['diverged']}")
        if lens in contents.with_optimum and (test := optimum(content)) is not None and not test.reached:
            problems.append(f"not converged: a step within the limits lowers the loss: {test}")
        messages = failures if lens in contents.constrained else unconstrained
        messages += [f"{lens} seed {seed}: {problem}" for problem in problems]
    accuracy = {}
    for (lens, classifier), seed in product(contents.measured, contents.seeds):
        correct = predictions.read(reproduced[MeasuredKey(lens, classifier, seed)])
        accuracy[lens, classifier, seed] = sum(predictions.accuracy_by_field(correct)) / correct.shape[1]
        failures += [
            f"{lens} seed {seed}: {classifier}: {what}: {share:.4f} of the captures differ"
            for what, share in differences(correct, lens, classifier, seed, measurements).items()
            if not share <= DIFFERENT
        ]
    for table in contents.tables:
        failures += _table_failures(table, accuracy, tables[table.name])
    return failures, unconstrained


def violated_limits(content: Mapping[str, Any], efl_mm: float, efl_tolerance: float) -> dict[str, float]:
    """Return negative margins [mm, or a fraction] by limit, from a lens file and for the specified EFL."""
    worst = content["worst_margin"]
    efl_error = abs(efl_mm / content["figures"]["efl_mm"] - 1)  # relative error of the power, as in designs
    margins = [
        *content["margins"].items(),
        (worst["limit"], worst["value"]),
        ("efl_tolerance", efl_tolerance - efl_error),
    ]
    return {limit: value for limit, value in margins if not value >= -ROUNDING}


def differences(
    reproduced: pandas.DataFrame, lens: str, classifier: str, seed: int, measurements: Measurements
) -> dict[str, float]:
    """Compute the fractions of captures for which stored files differ from the predictions `reproduced`.

    Stored predictions are compared by capture, metrics by the absolute difference in accuracy, mean over fields.
    """
    stored = measurements.correct(lens, classifier, seed)
    same_captures = stored.index.equals(reproduced.index) and stored.columns.equals(reproduced.columns)
    rows = read_table(measurements.metrics[MeasuredKey(lens, classifier, seed)])
    metrics = rows[rows["metric"] == "accuracy"].set_index("field")["value"].to_numpy()
    by_field = pandas.Series(predictions.accuracy_by_field(reproduced)).sub(pandas.Series(metrics)).abs()
    return {
        "stored predictions": float((stored != reproduced).to_numpy().mean()) if same_captures else 1.0,
        "metrics": float(by_field.mean(skipna=False) / 100),
    }


def _table_failures(contents: TableContents, accuracy: Mapping[tuple, float], path: Path) -> list[str]:
    """Return failures for the rows of a table whose accuracy is not reproduced."""
    failures, seeds = [], ", ".join(map(str, contents.seeds))
    for row in read_table(path, keep_default_na=False).to_dict("records"):
        sharp = row["elements"] == ""
        lens = SHARP if sharp else f"{row['elements']}-{row['design']}"
        classifier = row.get("classifier", contents.classifiers[0])
        name = classifier if sharp else names.measured_name(classifier, contents.restored)
        reproduced = sum(accuracy[lens, name, seed] for seed in contents.seeds) / len(contents.seeds)
        if not abs(row["accuracy"] - reproduced) <= 100 * DIFFERENT:
            value = f"{row['accuracy']:.2f} % in the table, {reproduced:.2f} % from the weights"
            failures.append(f"{lens} seed {seeds}: {name}: {contents.name}: {value}")
    return failures


def run(
    settings: VerificationContents,
    files: MeasurementFiles,
    reproduced: Sequence[Path],
    tables: Sequence[Path],
    verdicts: Path,
) -> None:
    """Print the verdicts and the results; exit with status 1 if there are failures.

    Args:
        reproduced: predictions of `settings.measured_keys`.
        tables: CSV files of `settings.tables`.
    """
    measurements = Measurements.of(settings, files)
    reproduced_files = dict(zip(settings.measured_keys, reproduced, strict=True))
    table_files = dict(zip((contents.name for contents in settings.tables), tables, strict=True))
    failures, unconstrained = verify(settings, measurements, reproduced_files, table_files)
    print(verdicts.read_text(encoding="utf-8"))  # all on standard output: Snakemake shows no log under --quiet
    for line in unconstrained:
        print(f"unconstrained: {line}")
    for line in failures:
        print(f"failed: {line}")
    count = f"{len(settings.lens_keys)} lenses and {len(settings.measured_keys)} measurements: {len(failures)} failures"
    print(f"Checked {count}.")
    if failures:
        print(f"failures, printed above: {len(failures)}", file=sys.stderr)  # for the summary of the run
        raise SystemExit(1)
