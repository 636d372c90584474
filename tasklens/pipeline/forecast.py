"""How long jobs take and how much memory: from the benchmarks that Snakemake keeps of finished jobs.

Those of this study on this machine come first. For the studies of `config/`, `durations.csv` there has what was
measured elsewhere; its durations are scaled by how much slower or faster this machine has been so far.
"""

import csv
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean

MEASURED = Path(__file__).parents[2] / "config" / "durations.csv"
_LIMIT = 4.0  # times the longest job of a stage: a job that takes longer hangs
_LEAST_LIMIT_MIN = 10.0
_UNKNOWN_MIN, _UNKNOWN_MB = 1440.0, 4000.0  # for a stage that nobody has measured
_MARGIN = 1.5  # of memory, over the largest job of a stage


@dataclass(frozen=True)
class Measured:
    """Jobs of one stage: mean and longest duration [s], largest memory [MB]."""

    seconds: float
    longest_s: float
    memory_mb: float


def benchmarks(folder: Path) -> dict[str, Measured]:
    """What Snakemake's benchmark files below a folder of results say, by stage."""
    found: dict[str, list[tuple[float, float]]] = {}
    for path in sorted(folder.rglob("*.tsv")):
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file, delimiter="\t"))
        if rows:
            stage = path.relative_to(folder).parts[0].removesuffix(".tsv")
            found.setdefault(stage, []).append((float(rows[-1]["s"]), _number(rows[-1]["max_rss"])))
    return {
        stage: Measured(mean(s for s, _ in jobs), max(s for s, _ in jobs), max(mb for _, mb in jobs))
        for stage, jobs in found.items()
    }


def _number(text: str) -> float:
    """A number of a file; 0 where there is none, as for the memory of a very short job."""
    try:
        return float(text)
    except ValueError:
        return 0.0


def elsewhere(study: str) -> dict[str, Measured]:
    """What was measured for a study of `config/`, by stage; nothing for other studies. Gaps of the file are zeros."""
    with open(MEASURED, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["study"] == study]
    return {row["stage"]: Measured(*(_number(row[n]) for n in ("seconds", "longest_s", "memory_mb"))) for row in rows}


class Durations:
    """Durations and memory of the jobs of a study.

    Args:
        study: its name.
        results: folder of its results.
    """

    def __init__(self, study: str, results: str):
        self.study, self.folder = study, Path(results) / "benchmarks"

    @cached_property
    def here(self) -> dict[str, Measured]:
        """Measured on this machine, in this study."""
        return benchmarks(self.folder)

    @cached_property
    def elsewhere(self) -> dict[str, Measured]:
        """Measured elsewhere."""
        return elsewhere(self.study)

    @property
    def scale(self) -> float:
        """How many times as long jobs take here as elsewhere; 1 until a job has finished here."""
        both = [stage for stage in self.here if stage in self.elsewhere]
        there = sum(self.elsewhere[stage].seconds for stage in both)
        return sum(self.here[stage].seconds for stage in both) / there if there else 1.0

    def seconds(self, stage: str) -> float | None:
        """Expected duration of a job of a stage [s]; None if nobody has measured one."""
        if stage in self.here:
            return self.here[stage].seconds
        return self.elsewhere[stage].seconds * self.scale if stage in self.elsewhere else None

    def limit_minutes(self, stage: str) -> int:
        """Time after which a scheduler may end a job of a stage [min]."""
        found = (measured[stage] for measured in (self.here, self.elsewhere) if stage in measured)
        known = [max(each.seconds, each.longest_s) for each in found]
        return round(max(_LEAST_LIMIT_MIN, _LIMIT * max(known) / 60) if known else _UNKNOWN_MIN)

    def memory_mb(self, stage: str) -> int:
        """Memory that a job of a stage is given [MB]."""
        known = [measured[stage].memory_mb for measured in (self.here, self.elsewhere) if stage in measured]
        return round(_MARGIN * max(known) if any(known) else _UNKNOWN_MB)

    def forecast(self, stages: Iterable[str], cores: int) -> str:
        """A line that says how long jobs of these stages take together on so many cores."""
        counts = Counter(stages)
        seconds = {stage: self.seconds(stage) for stage in counts}
        total = sum(count * (seconds[stage] or 0.0) for stage, count in counts.items())
        unknown = [stage for stage in counts if seconds[stage] is None]
        line = f"Study {self.study}: {counts.total()} jobs"
        if len(unknown) < len(counts):
            line += f", about {total / cores / 60:.0f} minutes on {cores} cores"
        return f"{line}; nothing is known yet of how long {', '.join(unknown)} takes." if unknown else f"{line}."
