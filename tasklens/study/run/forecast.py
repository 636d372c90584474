"""Forecasts of duration and memory of jobs, from Snakemake's benchmarks of finished jobs.

Benchmarks of this study on this machine take precedence. For the studies in `config/`, `config/durations.csv` has
values from another machine; these durations are scaled by the ratio of the durations measured so far.
"""

import csv
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean

from tasklens.recognition import class_folders
from tasklens.runtime.benchmarks import Benchmark, benchmarks, number
from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import ImageSettings
from tasklens.study.study import Study

MEASURED = Path(__file__).parents[3] / "config" / "durations.csv"
LARGE = 96  # image side [pixels] from which jobs resemble the studies of photographs more than the default study
COMPARABLE = 20_000  # training images; above this number, no measured duration applies
_LIMIT = 4.0  # ratio of a job's time limit to the longest job of its rule
_LEAST_LIMIT_MIN = 10.0
_UNKNOWN_MIN, _UNKNOWN_MB = 1440.0, 4000.0  # for a rule without benchmarks
_LEAST_MB = 1000.0  # benchmarks of short jobs see only their imports
_MARGIN = 1.5  # ratio of the memory for a job to the largest job of its rule


@dataclass(frozen=True)
class Measured:
    """Benchmarks of one rule: mean and longest duration [s], largest memory [MB]."""

    seconds: float
    longest_s: float
    memory_mb: float


def by_rule(folder: Path) -> dict[str, Measured]:
    """Read Snakemake's benchmark files below a folder, by rule."""
    groups: dict[str, list[Benchmark]] = {}
    for rule, job in benchmarks(folder):
        groups.setdefault(rule, []).append(job)
    return {
        rule: Measured(
            mean(job.seconds for job in jobs), max(job.seconds for job in jobs), max(job.memory_mb for job in jobs)
        )
        for rule, jobs in groups.items()
    }


def elsewhere(study: str) -> dict[str, Measured]:
    """Read the measurements of a study in `config/`, by rule; empty for other studies. Gaps in the file become 0."""
    with open(MEASURED, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["study"] == study]
    return {row["rule"]: Measured(*(number(row[n]) for n in ("seconds", "longest_s", "memory_mb"))) for row in rows}


class Durations:
    """Durations and memory of the jobs of a study.

    Args:
        study: name of the study.
        results: folder of its results.
        similar: name of a study in `config/` whose durations are used if no others are known.
    """

    def __init__(self, study: str, results: str, similar: str = ""):
        self.study, self.folder, self.similar = study, Path(results) / "benchmarks", similar

    @cached_property
    def here(self) -> dict[str, Measured]:
        """Benchmarks of this study on this machine, by rule."""
        return by_rule(self.folder)

    def read_again(self) -> None:
        """Read the benchmarks of this study anew, after a job."""
        vars(self).pop("here", None)

    @cached_property
    def elsewhere(self) -> dict[str, Measured]:
        """Benchmarks of this study on another machine, by rule."""
        return elsewhere(self.study.partition("/")[0])  # a point of a sweep has the name study/point

    @cached_property
    def guesses(self) -> dict[str, Measured]:
        """Benchmarks of the similar study, by rule; they set no limits of time and memory."""
        return elsewhere(self.similar)

    @property
    def scale(self) -> float:
        """Ratio of durations on this machine to durations on the other one; 1 until a job finishes here."""
        both = [rule for rule in self.here if rule in self.elsewhere]
        there = sum(self.elsewhere[rule].seconds for rule in both)
        return sum(self.here[rule].seconds for rule in both) / there if there else 1.0

    def seconds(self, rule: str) -> float | None:
        """Return the expected duration of a job of a rule [s]; None without benchmarks."""
        if rule in self.here:
            return self.here[rule].seconds
        if rule in self.elsewhere:
            return self.elsewhere[rule].seconds * self.scale
        return self.guesses[rule].seconds if rule in self.guesses else None

    def limit_minutes(self, rule: str) -> int:
        """Return the time limit of a job of a rule [min]."""
        sources = [(1.0, self.here), (max(1.0, self.scale), self.elsewhere)]
        longest = [scale * max(table[rule].seconds, table[rule].longest_s) for scale, table in sources if rule in table]
        return round(max(_LEAST_LIMIT_MIN, _LIMIT * max(longest) / 60) if longest else _UNKNOWN_MIN)

    def memory_mb(self, rule: str) -> int:
        """Return the memory requested for a job of a rule [MB]."""
        largest = [table[rule].memory_mb for table in (self.here, self.elsewhere) if rule in table]
        return round(max(_LEAST_MB, _MARGIN * max(largest)) if any(largest) else _UNKNOWN_MB)

    def total(self, rules: Iterable[str]) -> tuple[float, list[str]]:
        """Return the total duration of jobs of these rules on one core [s], and the rules of unknown duration."""
        counts = Counter(rules)
        seconds = {rule: self.seconds(rule) for rule in counts}
        total = sum(count * (seconds[rule] or 0.0) for rule, count in counts.items())
        return total, [rule for rule in counts if seconds[rule] is None]

    def forecast(self, rules: Sequence[str], cores: int) -> str:
        """Describe in one line the number of jobs of these rules and their total duration on `cores` cores."""
        counts, (total, unknown) = Counter(rules), self.total(rules)
        line = f"Study {self.study}: {counts.total()} job{'s' if counts.total() != 1 else ''}"
        if len(unknown) < len(counts):
            line += f", about {duration(total / cores)} on {cores} core{'s' if cores > 1 else ''}"
        if any(rule in self.guesses and rule not in self.here and rule not in self.elsewhere for rule in counts):
            line += f", if jobs are as long as those of the study {self.similar}"
        return f"{line}; the duration of {', '.join(unknown)} is not known yet." if unknown else f"{line}."


def durations_of(study: Study) -> Durations:
    """Return the durations of a study; rules without benchmarks use those of a study with similar images."""
    similar = "small"
    if study.images.size >= LARGE:
        similar = (
            "photographs_fine_tuned" if study.fine_tuning.epochs else "photographs" if study.designs else "ranking"
        )
    return Durations(
        study.name, f"results/{study.name}", similar if _training_images(study.images) <= COMPARABLE else ""
    )


def _training_images(images: ImageSettings) -> float:
    """Return the number of training images, counted up to `COMPARABLE`; infinity if their folder is missing."""
    if images.train is not None:
        return images.train
    assert images.folder is not None  # rendered images need counts
    try:
        return class_folders.count(class_folders.train_folder(images.folder), COMPARABLE + 1)
    except (FileError, OSError):
        return math.inf


def duration(seconds: float) -> str:
    """Format a duration with at most two units, such as `1 h 20 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
