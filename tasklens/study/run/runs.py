"""State of a run of a study, in results/<study>/run.json: which jobs are waiting, running, done or failed.

Snakemake's process writes it whenever a job begins or ends. Each running job writes its own progress file, on whichever
machine it runs. So another terminal can read both, also on a cluster.
"""

import json
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import psutil

from tasklens.runtime.files import FileError, write_text
from tasklens.runtime.progress import read_progress
from tasklens.study.run.forecast import Durations, duration

WAITING, RUNNING, DONE, FAILED = "waiting", "running", "done", "failed"
_SILENT_S = 120.0  # a running job without news for longer is called silent


@dataclass
class Job:
    """One job: its rule and state, its start [s since 1970], its duration [s], and its result in words."""

    rule: str
    state: str = WAITING
    started: float | None = None
    seconds: float | None = None
    result: str = ""


@dataclass
class Run:
    """A run: its study and results folder, the process, and all its jobs by label, such as `design/doublet-spot-seed0`.

    Attributes:
        ended: end of the run [s since 1970]; None before the end, or if its process was killed.
    """

    study: str
    folder: str
    cores: int
    jobs: dict[str, Job]
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)
    started: float = field(default_factory=time.time)
    ended: float | None = None

    def begin(self, label: str) -> None:
        """Record that a job begins."""
        if label in self.jobs:
            self.jobs[label].state, self.jobs[label].started = RUNNING, time.time()
            self.save()

    def end(self, label: str, state: str, seconds: float | None = None, result: str = "") -> None:
        """Record that a job has ended; by default its duration is the time since it started."""
        job = self.jobs[label]
        job.state, job.result = state, result
        job.seconds = time.time() - (job.started or time.time()) if seconds is None else seconds
        self.save()

    def finish(self) -> None:
        """Record that the run has ended."""
        self.ended = time.time()
        self.save()

    def save(self) -> None:
        """Write the state."""
        write_text(Path(self.folder, "run.json"), json.dumps(asdict(self), indent=1) + "\n")

    def labels(self, state: str) -> list[str]:
        """Return the jobs in a state."""
        return [label for label, job in self.jobs.items() if job.state == state]

    @property
    def is_alive(self) -> bool:
        """Return whether the run is still going, as far as this machine can tell."""
        return self.ended is None and (self.host != socket.gethostname() or psutil.pid_exists(self.pid))

    def known_seconds(self, durations: Durations) -> tuple[list[float], list[float]]:
        """Return the remaining times of waiting and of running jobs [s]; leave out jobs of unknown duration."""
        waiting = [durations.seconds(self.jobs[label].rule) for label in self.labels(WAITING)]
        running = [self._remaining_seconds(label, durations) for label in self.labels(RUNNING)]
        return [value for value in waiting if value is not None], [value for value in running if value is not None]

    def _remaining_seconds(self, label: str, durations: Durations) -> float | None:
        """Return the remaining time of a running job [s]: the longer of the estimates by its phase and by its rule."""
        job, progress = self.jobs[label], self.progress(label)
        expected = durations.seconds(job.rule)
        by_benchmark = (
            None if expected is None or job.started is None else max(0.0, expected - (time.time() - job.started))
        )
        by_phase = None
        if progress and "remaining_s" in progress:
            by_phase = max(0.0, progress["remaining_s"] - (time.time() - progress["updated"]))
        estimates = [seconds for seconds in (by_benchmark, by_phase) if seconds is not None]
        return max(estimates) if estimates else None

    def progress(self, label: str) -> Mapping[str, Any] | None:
        """Read the progress of a job; None if it has not written any yet."""
        return read_progress(self.folder, label)

    def describe(self, label: str, durations: Durations) -> str:
        """Describe a running job in one line: phase, step, values and time left."""
        progress = self.progress(label)
        words = [title(label)]
        if progress is None:
            return f"{words[0]}  starting"
        if "phase" in progress:
            words.append(f"{progress['phase']} {progress['step']}/{progress['total']}")
            words += [f"{name} {value:.4g}" for name, value in progress["values"].items()]
        left = self._remaining_seconds(label, durations)
        if left:
            words.append(f"{duration(left)} left")
        silent = time.time() - progress["updated"]
        if silent > _SILENT_S and "phase" in progress:
            words.append(f"silent for {duration(silent)}")
        return "  ".join(words)


def seconds_left(pairs: Sequence[tuple[Run, Durations]]) -> float | None:
    """Return the duration of the remaining jobs of concurrent runs on their cores [s]; None if no duration is known."""
    estimates = [run.known_seconds(durations) for run, durations in pairs]
    running = [seconds for _, times in estimates for seconds in times]
    all_times = running + [seconds for times, _ in estimates for seconds in times]
    return max([*running, sum(all_times) / pairs[0][0].cores]) if all_times else None


def headline(pairs: Sequence[tuple[Run, Durations]]) -> str:
    """Describe concurrent runs in one line: number of finished jobs, and time left."""
    done, failed = (sum(len(run.labels(state)) for run, _ in pairs) for state in (DONE, FAILED))
    total = sum(len(run.jobs) for run, _ in pairs)
    line = f"{done} of {total} jobs" + (f", {failed} failed" if failed else "")
    left = seconds_left(pairs)
    if left is None:
        return line
    waiting = [(run.jobs[label], durations) for run, durations in pairs for label in run.labels(WAITING)]
    more = any(durations.seconds(job.rule) is None for job, durations in waiting)
    return f"{line}, {'more than ' if more else 'about '}{duration(left)} left"


def status(run: Run, durations: Durations) -> list[str]:
    """Describe a run in lines: its progress, its running jobs, its failed jobs."""
    lines = [f"{run.study}: {headline([(run, durations)])}"]
    if run.ended is not None:
        span = duration(run.ended - run.started)
        lines[0] = f"{run.study}: the last run ended after {span}, {len(run.labels(DONE))} of {len(run.jobs)} jobs done"
    elif not run.is_alive:
        lines[0] = f"{run.study}: the last run was killed, {len(run.labels(DONE))} of {len(run.jobs)} jobs done"
        lines.append("  to continue: `snakemake --unlock`, then the same `snakemake` command")
    else:
        lines += [f"  {run.describe(label, durations)}" for label in run.labels(RUNNING)]
    for label in run.labels(FAILED):
        lines += [f"FAILED  {title(label)}: {run.jobs[label].result}", f"        {run.folder}/logs/{label}.log"]
    return lines


def read(folder: Path) -> Run | None:
    """Read the state of the last run of a study from its results folder; None if there is none.

    Raises:
        FileError: the file was not written by this version.
    """
    path = folder / "run.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        jobs = {label: Job(**job) for label, job in content["jobs"].items()}
        return Run(**content | {"jobs": jobs, "folder": str(folder)})
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError):
        raise FileError(f"{path}: not the state of a run; the next run rewrites it") from None


def title(label: str) -> str:
    """Return a label as words, such as `design doublet-spot-seed0`."""
    return label.replace("/", " ", 1)
