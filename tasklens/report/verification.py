"""Whether a finished study keeps its word: limits of the lenses, and accuracies that come out again.

Stored weights recognise all test pictures anew, through the cached PSFs (stage `reproduce`, a job per measurement).
What comes out is compared with the pictures and metrics that fine-tuning left, and with the tables.
"""

from dataclasses import dataclass
from pathlib import Path

import pandas

from tasklens.pipeline.jobs import TableJob, VerificationJob
from tasklens.pipeline.layout import SHARP, Layout
from tasklens.report import predictions as pictures
from tasklens.report.tables import lens_file

ROUNDING = 1e-6  # [mm or a fraction] by which a margin may be negative
EFL_TOLERANCE = 0.02
DIFFERENT = 1e-3  # share of captures that may be recognised differently; on the machine that wrote them none is


@dataclass(frozen=True)
class Failure:
    """One thing that a lens breaks: which limit, and the value found."""

    lens: str
    seed: str
    limit: str
    value: str

    def __str__(self) -> str:
        return f"{self.lens} seed {self.seed}: {self.limit}: {self.value}"


@dataclass(frozen=True)
class Findings:
    """What was found: failures; limits broken by lenses that never promised to keep them; how much was checked."""

    failures: list[Failure]
    unpromised: list[Failure]
    lenses: int
    measurements: int


def verify(job: VerificationJob, layout: Layout) -> Findings:
    """Check every lens, measurement and table of a study; all checks are done, whatever fails.

    Raises:
        FileNotFoundError: a lens, a measurement, its reproduction or a table is missing.
    """
    failures, unpromised, accuracy = [], [], {}
    for lens in job.lenses:
        for seed in job.seeds:
            content = lens_file(Path(layout.lens(lens, seed)))
            broken = broken_limits(content, job.efl_mm[lens])
            found = [Failure(lens, str(seed), limit, f"margin {value:.4g}") for limit, value in broken.items()]
            if "diverged" in content.get("origin", {}):
                found.append(Failure(lens, str(seed), "diverged", content["origin"]["diverged"]))
            (failures if lens in job.promising else unpromised).extend(found)
    for lens, classifier in job.measured:
        for seed in job.seeds:
            anew = pictures.read(layout.reproduced(lens, seed, classifier))
            accuracy[lens, classifier, seed] = sum(pictures.accuracy_by_field(anew)) / anew.shape[1]
            failures += [
                Failure(lens, str(seed), f"{classifier}: {what}", f"{share:.4f} of the captures differ")
                for what, share in differences(anew, lens, seed, classifier, layout).items()
                if not share <= DIFFERENT
            ]
    for table in job.tables:
        failures += _table_failures(table, accuracy, layout)
    checked = len(job.seeds) * len(job.lenses), len(accuracy)
    return Findings(failures, unpromised, *checked)


def broken_limits(content: dict, efl_mm: float) -> dict[str, float]:
    """Margins below zero [mm, or a fraction] by limit: those in a lens file, and that of the specified focal length."""
    worst = content["worst_margin"]
    missed = abs(efl_mm / content["figures"]["efl_mm"] - 1)  # of the power, as designs are held to it
    margins = [*content["margins"].items(), (worst["limit"], worst["value"]), ("efl_tolerance", EFL_TOLERANCE - missed)]
    return {limit: value for limit, value in margins if not value >= -ROUNDING}


def differences(anew: pandas.DataFrame, lens: str, seed: int, classifier: str, layout: Layout) -> dict[str, float]:
    """Share of captures in which stored files differ from the reproduction `anew`.

    By picture from the stored pictures; from the metrics file by the mean over fields of the difference in accuracy.
    """
    stored = pictures.read(layout.pictures(lens, seed, classifier))
    alike = stored.index.equals(anew.index) and stored.columns.equals(anew.columns)
    rows = pandas.read_csv(layout.metrics(lens, seed, classifier))
    metrics = rows[rows["metric"] == "accuracy"].set_index("field")["value"].to_numpy()
    by_field = pandas.Series(pictures.accuracy_by_field(anew)).sub(pandas.Series(metrics)).abs()
    return {
        "stored pictures": float((stored != anew).to_numpy().mean()) if alike else 1.0,
        "metrics": float(by_field.mean(skipna=False) / 100),
    }


def _table_failures(job: TableJob, accuracy: dict[tuple, float], layout: Layout) -> list[Failure]:
    """Rows of a table whose accuracy is not that of the stored weights."""
    failures = []
    table = pandas.read_csv(layout.table(job.name, "csv"), keep_default_na=False)
    for row in table.to_dict("records"):
        sharp = row["design"] == "reference"
        lens = SHARP if sharp else f"{row['elements']}-{row['design']}"
        classifier = row.get("classifier", job.classifiers[0])
        seen = classifier if sharp else job.seen(classifier)
        anew = sum(accuracy[lens, seen, seed] for seed in job.seeds) / len(job.seeds)
        if not abs(row["accuracy"] - anew) <= 100 * DIFFERENT:
            value = f"{row['accuracy']:.2f} % in the table, {anew:.2f} % from the weights"
            failures.append(Failure(lens, ", ".join(map(str, job.seeds)), f"{seen}: {job.name}", value))
    return failures


def summary(findings: Findings) -> str:
    """A line for everything broken, with `failed` or `not promised` before it, and one for what was checked."""
    lines = [f"not promised: {failure}" for failure in findings.unpromised]
    lines += [f"failed: {failure}" for failure in findings.failures]
    count = f"{findings.lenses} lenses and {findings.measurements} measurements: {len(findings.failures)} failures"
    return "\n".join([*lines, f"Checked {count}."])
