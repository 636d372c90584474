"""Which jobs of a study remain, and what they take: Snakemake's own plan, with durations and memory."""

import csv
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tasklens.pipeline import report_jobs  # noqa: F401  declares the stages
from tasklens.pipeline.digest import ROOT
from tasklens.pipeline.forecast import Durations
from tasklens.pipeline.stage import STAGES, Stage, results
from tasklens.runtime.errors import InputError
from tasklens.study.study import Study


@dataclass
class Planned:
    """Jobs of one stage: labels of those that are done, that were never done, and that are done again."""

    done: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    again: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)  # existing outputs of the stage

    @property
    def remaining(self) -> int:
        """Number of jobs that are to run."""
        return len(self.missing) + len(self.again)


def plan(studies: Iterable[Study], files: Sequence[Path], target: str) -> dict[str, dict[str, Planned]]:
    """Ask Snakemake which jobs a target needs, by name of the study and by stage; it takes seconds.

    Args:
        studies: those of the files: of a sweep the study itself and one for each point.
        files: the files of the study, laid over each other.

    Raises:
        InputError: Snakemake cannot plan; with its words.
    """
    words = ["--snakefile", str(ROOT / "Snakefile"), "--cores", "1", "--summary", target]
    command = [sys.executable, "-m", "snakemake", *words, "--configfile", *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("Using ")]
        raise InputError(f"Snakemake cannot plan {target} of {', '.join(map(str, files))}: {' '.join(said)}")
    known = {study.name: study for study in sorted(studies, key=lambda study: study.name)}  # points after their study
    found: dict[str, dict[str, Planned]] = {name: {} for name in known}
    for row in csv.DictReader(done.stdout.splitlines(), delimiter="\t"):
        stage = STAGES.get(row["rule"]) or STAGES.get(row["rule"].rpartition("_")[0])  # a point's rule has a number
        if stage is None:
            continue
        path = Path(row["output_file"])
        study = [each for each in known.values() if path.is_relative_to(results(each))][-1]
        planned = found[study.name].setdefault(stage.name, Planned())
        if row["date"] != "-":
            planned.files.append(path)
        if label := _label(stage, study, path):
            state = "done" if row["plan"] == "no update" else "missing" if row["date"] == "-" else "again"
            getattr(planned, state).append(label)
    return {name: {stage: jobs[stage] for stage in STAGES if stage in jobs} for name, jobs in found.items() if jobs}


def _label(stage: Stage, study: Study, path: Path) -> str | None:
    """Return the label of the job whose first output is `path`; None for its other outputs."""
    pattern = re.escape(str(next(iter(stage.outputs(study).values()))))
    match = re.fullmatch(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", pattern), str(path))
    return None if match is None else stage.label.format(**match.groupdict())


def seconds(planned: dict[str, Planned], durations: Durations) -> tuple[float, list[str]]:
    """Return the duration of the remaining jobs on one core [s], and the stages of which it is not known."""
    remaining = {stage: jobs.remaining for stage, jobs in planned.items() if jobs.remaining}
    known = {stage: durations.seconds(stage) for stage in remaining}
    total = sum(count * (known[stage] or 0.0) for stage, count in remaining.items())
    return total, [stage for stage, each in known.items() if each is None]


def memory_mb(planned: dict[str, Planned], durations: Durations) -> int:
    """Return the memory that the largest remaining job asks for [MB]; 0 if none remains."""
    return max((durations.memory_mb(stage) for stage, jobs in planned.items() if jobs.remaining), default=0)


def disk_mb(study: Study, planned: dict[str, Planned]) -> tuple[float, list[str]]:
    """Return what the outputs of the missing jobs take on the disk [MB], and the stages of which it is not known.

    Images are 3 size^2 bytes each; a job of another stage takes what those that are done take on average.
    """
    total, unknown = 0.0, []
    for stage, jobs in planned.items():
        if not jobs.missing:
            continue
        if stage == "images" and study.images.train is not None and study.images.test is not None:
            count = study.images.train + study.images.minival + study.images.test
            total += count * 3 * study.images.size**2 / 1e6
        elif finished := len(jobs.done) + len(jobs.again):
            total += len(jobs.missing) * sum(path.stat().st_size for path in jobs.files) / finished / 1e6
        else:
            unknown.append(stage)
    return total, unknown
