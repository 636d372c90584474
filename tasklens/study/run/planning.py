"""Remaining jobs of a study: Snakemake's own plan, with durations, memory and disk space."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tasklens.runtime.errors import InputError
from tasklens.study.loading import whole_study_name
from tasklens.study.run.changes import PlannedJob
from tasklens.study.run.digest import SNAKEFILE
from tasklens.study.run.forecast import Durations
from tasklens.study.study import Study


@dataclass
class Planned:
    """Jobs of one rule: labels of finished jobs, of missing jobs, and of reruns."""

    done: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    rerun: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)  # existing outputs of the rule

    @property
    def remaining(self) -> int:
        """Number of jobs that still have to run."""
        return len(self.missing) + len(self.rerun)


def dump(jobs: Iterable[PlannedJob]) -> str:
    """Return jobs as JSON."""
    return json.dumps([asdict(job) for job in jobs])


def plan(files: Sequence[Path], target: str) -> dict[str, dict[str, Planned]]:
    """Return the jobs of a target, by study and by rule, from a dry run of Snakemake; it takes seconds.

    Jobs of the parts of a study count as its own.

    Args:
        files: the files of the study; later ones override earlier ones.

    Raises:
        InputError: Snakemake cannot plan; the message contains its output.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "jobs.json")
        options = ["--snakefile", str(SNAKEFILE), "--cores", "1", "--dry-run", target]
        command = [sys.executable, "-m", "snakemake", *options, "--configfile", *map(str, files)]
        process = subprocess.run([*command, "--config", f"plan={path}"], capture_output=True, text=True)
        if process.returncode:
            printed = (process.stdout + process.stderr).rpartition("Building DAG of jobs...\n")[2]  # without the header
            lines = [line for line in printed.splitlines() if line.strip() and not line.startswith("Using ")]
            raise InputError(f"Snakemake cannot plan {target} of {', '.join(map(str, files))}: {' '.join(lines)}")
        rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    plans: dict[str, dict[str, Planned]] = {}
    for job in (PlannedJob(**row) for row in rows):
        planned = plans.setdefault(whole_study_name(job.study), {}).setdefault(job.rule, Planned())
        state = "done" if not job.remains else "rerun" if job.outputs else "missing"
        getattr(planned, state).append(job.label)
        planned.files += map(Path, job.outputs)
    return dict(sorted(plans.items()))  # a sweep, then its points


def remaining_rules(planned: dict[str, Planned]) -> list[str]:
    """Return the rule of each job that still has to run."""
    return [rule for rule, jobs in planned.items() for _ in range(jobs.remaining)]


def memory_mb(planned: dict[str, Planned], durations: Durations) -> int:
    """Return the memory that the largest remaining job requests [MB]; 0 if none remains."""
    return max((durations.memory_mb(rule) for rule, jobs in planned.items() if jobs.remaining), default=0)


def disk_mb(study: Study, planned: dict[str, Planned]) -> tuple[float, list[str]]:
    """Return the disk space for the outputs of the missing jobs [MB], and the rules of unknown size.

    An image takes 3 size^2 bytes. A job of another rule takes the mean of the finished jobs of its rule.
    """
    total, unknown = 0.0, []
    for rule, jobs in planned.items():
        if not jobs.missing:
            continue
        if rule == "images" and study.images.train is not None and study.images.test is not None:
            count = study.images.train + study.images.minival + study.images.test
            total += count * 3 * study.images.size**2 / 1e6
        elif done_count := len(jobs.done) + len(jobs.rerun):
            total += len(jobs.missing) * sum(path.stat().st_size for path in jobs.files) / done_count / 1e6
        else:
            unknown.append(rule)
    return total, unknown
