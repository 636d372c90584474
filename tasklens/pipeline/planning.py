"""Which jobs of a study remain, and what they take: Snakemake's own plan, with durations and memory."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tasklens.pipeline.changes import PlannedJob
from tasklens.pipeline.digest import ROOT
from tasklens.pipeline.forecast import Durations
from tasklens.runtime.errors import InputError
from tasklens.study.study import Study


@dataclass
class Planned:
    """Jobs of one rule: labels of those that are done, that were never done, and that are done again."""

    done: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    again: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)  # existing outputs of the rule

    @property
    def remaining(self) -> int:
        """Number of jobs that are to run."""
        return len(self.missing) + len(self.again)


def dump(jobs: Iterable[PlannedJob]) -> str:
    """Return jobs as JSON."""
    return json.dumps([asdict(job) for job in jobs])


def plan(files: Sequence[Path], target: str) -> dict[str, dict[str, Planned]]:
    """Ask Snakemake which jobs a target needs, by name of the study and by rule; it takes seconds.

    Args:
        files: the files of the study, laid over each other.

    Raises:
        InputError: Snakemake cannot plan; with its words.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "jobs.json")
        words = ["--snakefile", str(ROOT / "Snakefile"), "--cores", "1", "--dry-run", target]
        command = [sys.executable, "-m", "snakemake", *words, "--configfile", *map(str, files)]
        done = subprocess.run([*command, "--config", f"plan={path}"], capture_output=True, text=True)
        if done.returncode:
            said = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("Using ")]
            raise InputError(f"Snakemake cannot plan {target} of {', '.join(map(str, files))}: {' '.join(said)}")
        rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    found: dict[str, dict[str, Planned]] = {}
    for job in (PlannedJob(**row) for row in rows):
        planned = found.setdefault(job.study, {}).setdefault(job.rule, Planned())
        state = "done" if not job.remains else "again" if job.outputs else "missing"
        getattr(planned, state).append(job.label)
        planned.files += map(Path, job.outputs)
    return dict(sorted(found.items()))  # a sweep, then its points


def seconds(planned: dict[str, Planned], durations: Durations) -> tuple[float, list[str]]:
    """Return the duration of the remaining jobs on one core [s], and the rules of which it is not known."""
    remaining = {rule: jobs.remaining for rule, jobs in planned.items() if jobs.remaining}
    known = {rule: durations.seconds(rule) for rule in remaining}
    total = sum(count * (known[rule] or 0.0) for rule, count in remaining.items())
    return total, [rule for rule, each in known.items() if each is None]


def memory_mb(planned: dict[str, Planned], durations: Durations) -> int:
    """Return the memory that the largest remaining job asks for [MB]; 0 if none remains."""
    return max((durations.memory_mb(rule) for rule, jobs in planned.items() if jobs.remaining), default=0)


def disk_mb(study: Study, planned: dict[str, Planned]) -> tuple[float, list[str]]:
    """Return what the outputs of the missing jobs take on the disk [MB], and the rules of which it is not known.

    Images are 3 size^2 bytes each; a job of another rule takes what those that are done take on average.
    """
    total, unknown = 0.0, []
    for rule, jobs in planned.items():
        if not jobs.missing:
            continue
        if rule == "images" and study.images.train is not None and study.images.test is not None:
            count = study.images.train + study.images.minival + study.images.test
            total += count * 3 * study.images.size**2 / 1e6
        elif finished := len(jobs.done) + len(jobs.again):
            total += len(jobs.missing) * sum(path.stat().st_size for path in jobs.files) / finished / 1e6
        else:
            unknown.append(rule)
    return total, unknown
