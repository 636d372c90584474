"""State of a run of a study, in results/<study>/run.json: which jobs wait, run, are done or have failed.

Snakemake's process writes it whenever a job begins or ends. How far a running job is, is in its progress file, which
the job writes itself, on whichever machine; so that both can be read from another terminal, also of a cluster.
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

from tasklens.pipeline.forecast import Durations, duration
from tasklens.runtime import progress_file
from tasklens.runtime.files import FileError, write_text

WAITING, RUNNING, DONE, FAILED = "waiting", "running", "done", "failed"
_SILENT_S = 120.0  # a running job that has not written for longer is said to be silent


@dataclass
class Job:
    """One job: its rule and state, when it began [s since 1970], how long it took [s], and its result in words."""

    rule: str
    state: str = WAITING
    began: float | None = None
    seconds: float | None = None
    result: str = ""


@dataclass
class Run:
    """A run: its study and results folder, the process, and all its jobs by label, such as `design/doublet-spot-seed0`.

    Attributes:
        ended: when the run ended [s since 1970]; None before, and where its process was killed.
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
        """Note that a job begins."""
        if label in self.jobs:
            self.jobs[label].state, self.jobs[label].began = RUNNING, time.time()
            self.save()

    def end(self, label: str, state: str, seconds: float | None = None, result: str = "") -> None:
        """Note that a job has ended, by default after the time since it began."""
        job = self.jobs[label]
        job.state, job.result = state, result
        job.seconds = time.time() - (job.began or time.time()) if seconds is None else seconds
        self.save()

    def finish(self) -> None:
        """Note that the run has ended."""
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
        """Whether the run goes on, as far as this machine can know."""
        return self.ended is None and (self.host != socket.gethostname() or psutil.pid_exists(self.pid))

    def seconds_left(self, durations: Durations) -> float | None:
        """Return how long the remaining jobs take on the run's cores [s]; None where nothing is known of any."""
        return seconds_left([(self, durations)])

    def known_seconds(self, durations: Durations) -> tuple[list[float], list[float]]:
        """Return how long each waiting and each running job still takes [s], of those of which it is known."""
        waiting = [durations.seconds(self.jobs[label].rule) for label in self.labels(WAITING)]
        running = [self._left(label, durations) for label in self.labels(RUNNING)]
        return [each for each in waiting if each is not None], [each for each in running if each is not None]

    def _left(self, label: str, durations: Durations) -> float | None:
        """Return how long a running job still takes [s]: the longer of what its phase and its rule's jobs say."""
        job, found = self.jobs[label], self.progress(label)
        expected = durations.seconds(job.rule)
        by_benchmark = None if expected is None or job.began is None else max(0.0, expected - (time.time() - job.began))
        own = None
        if found and "remaining_s" in found:
            own = max(0.0, found["remaining_s"] - (time.time() - found["updated"]))
        known = [seconds for seconds in (by_benchmark, own) if seconds is not None]
        return max(known) if known else None

    def progress(self, label: str) -> Mapping[str, Any] | None:
        """Read how far a job is; None where it has not begun to say."""
        return progress_file.read(self.folder, label)

    def describe(self, label: str, durations: Durations) -> str:
        """Say in one line what a running job does: phase, step, values and time left."""
        found = self.progress(label)
        words = [title(label)]
        if found is None:
            return f"{words[0]}  starting"
        if "phase" in found:
            words.append(f"{found['phase']} {found['step']}/{found['total']}")
            words += [f"{name} {value:.4g}" for name, value in found["values"].items()]
        left = self._left(label, durations)
        if left:
            words.append(f"{duration(left)} left")
        silent = time.time() - found["updated"]
        if silent > _SILENT_S and "phase" in found:
            words.append(f"silent for {duration(silent)}")
        return "  ".join(words)

    def is_underestimated(self, durations: Durations) -> bool:
        """Return whether nothing is known of how long some waiting jobs take."""
        return any(durations.seconds(self.jobs[label].rule) is None for label in self.labels(WAITING))


def seconds_left(found: Sequence[tuple[Run, Durations]]) -> float | None:
    """Return how long the remaining jobs of runs side by side take on their cores [s]; None where nothing is known."""
    known = [run.known_seconds(durations) for run, durations in found]
    running = [seconds for _, each in known for seconds in each]
    every = running + [seconds for each, _ in known for seconds in each]
    return max([*running, sum(every) / found[0][0].cores]) if every else None


def headline(found: Sequence[tuple[Run, Durations]]) -> str:
    """Say in one line how many jobs of runs side by side are done, and how long the others take."""
    done, failed = (sum(len(run.labels(state)) for run, _ in found) for state in (DONE, FAILED))
    total = sum(len(run.jobs) for run, _ in found)
    line = f"{done} of {total} jobs" + (f", {failed} failed" if failed else "")
    left = seconds_left(found)
    if left is None:
        return line
    more = any(run.is_underestimated(durations) for run, durations in found)
    return f"{line}, {'more than ' if more else 'about '}{duration(left)} left"


def status(run: Run, durations: Durations) -> list[str]:
    """Describe a run in lines: how far it is, what runs, what has failed."""
    lines = [f"{run.study}: {headline([(run, durations)])}"]
    if run.ended is not None:
        took = duration(run.ended - run.started)
        lines[0] = f"{run.study}: the last run ended after {took}, {len(run.labels(DONE))} of {len(run.jobs)} jobs done"
    elif not run.is_alive:
        lines[0] = f"{run.study}: the last run was killed, {len(run.labels(DONE))} of {len(run.jobs)} jobs done"
        lines.append("  the same `snakemake` command goes on, after `snakemake --unlock`")
    else:
        lines += [f"  {run.describe(label, durations)}" for label in run.labels(RUNNING)]
    for label in run.labels(FAILED):
        lines += [f"FAILED  {title(label)}: {run.jobs[label].result}", f"        {run.folder}/logs/{label}.log"]
    return lines


def read(folder: Path) -> Run | None:
    """Read the state of the last run of a study from its results folder; None where there is none.

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
        raise FileError(f"{path}: not the state of a run; the next run writes it anew") from None


def title(label: str) -> str:
    """Return a label as words, such as `design doublet-spot-seed0`."""
    return label.replace("/", " ", 1)
