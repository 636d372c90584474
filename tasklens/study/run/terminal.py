"""Terminal output of a run of the workflow: a line for each finished job, and a bar with the running jobs.

Snakemake reports to a Python logger. Our handler replaces Snakemake's handler for the terminal, and stores the state of
the run (`runs`). Snakemake's own log file below .snakemake/log stays complete. Without a terminal, one line a
minute replaces the bar.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from snakemake.logging import logger

from tasklens.runtime import benchmarks
from tasklens.runtime.job import place
from tasklens.study.run import closing, runs
from tasklens.study.run.changes import PlannedJob
from tasklens.study.run.forecast import Durations, duration, durations_of
from tasklens.study.run.outcome import last_lines, outcome
from tasklens.study.run.snakemake_internals import take_terminal
from tasklens.study.study import Study

_MINUTE_S = 60.0
_SHOWN = 8  # running jobs below the bar
_LOG_LINES = 12  # of a failed job
_NOTHING = "Nothing to be done"
_STOPPING = "Terminating processes"  # on Ctrl-C; the jobs then end with errors
_PASSED_ON = (_STOPPING, "Will exit after", "Unlock", "Deleting ", "archived ", "Report created")
_REPLACED = (
    "Exiting because a job execution failed",
    "At least one job did not complete",
    "non-zero exit status",
)  # this handler prints its own messages instead


class Terminal(logging.Handler):
    """Handler of Snakemake's log records; it prints nothing if the user has chosen another logger or `--quiet`."""

    def __init__(
        self,
        study: Study,
        study_named: Callable[[str], Study],
        quiet: bool,
        unrecorded: Callable[[], str],
        logger: logging.Logger = logger,
    ):
        super().__init__()
        self.study = study
        self.study_named = study_named
        self.unrecorded = unrecorded
        self.durations: dict[str, Durations] = {}  # by name of the study, as `runs`
        self.runs: dict[str, runs.Run] = {}  # by name of the study; a sweep has several
        self.live: Live | None = None
        self.stopped = threading.Event()
        self.stopping = False  # on the user's request
        self.jobs: dict[int, tuple[runs.Run, str, list[str]]] = {}  # label and outputs by Snakemake's number
        self.console = Console(stderr=True, quiet=not take_terminal(self, quiet, logger), highlight=False)

    def begin(self, jobs: Mapping[str, Mapping[str, PlannedJob]], cores: int) -> None:
        """Start showing a run.

        Args:
            jobs: the jobs of each study by their labels.
            cores: number of jobs at a time.
        """
        for name, planned in jobs.items():
            states = {label: runs.Job(job.rule) for label, job in planned.items()}
            self.runs[name] = runs.Run(name, f"results/{name}", cores, states)
            self.runs[name].save()
            self.durations[name] = durations_of(self.study_named(name))
        if self.console.is_terminal and not self.console.is_dumb_terminal:
            self.live = Live(
                get_renderable=self._bar,
                console=self.console,
                refresh_per_second=2,
                transient=True,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self.live.start()
        else:
            threading.Thread(target=self._every_minute, daemon=True).start()

    def end(self) -> None:
        """Stop showing the run."""
        self.stopped.set()
        if self.live is not None:
            self.live.stop()
        for run in self.runs.values():
            if run.ended is None:
                run.finish()

    def close(self) -> None:
        """Restore the terminal, however the run ended."""
        self.end()
        super().close()

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record of Snakemake, or process its event of a job."""
        try:
            event = str(getattr(record, "event", "") or "")
            if event == "job_info":
                self._begin_job(record)
            elif event == "job_finished":
                self._finish_job(record.job_id)  # type: ignore[attr-defined]
            elif event == "job_error":
                self._fail_job(record)
            elif record.levelno >= logging.WARNING or str(record.msg).startswith(_PASSED_ON):
                self.stopping |= str(record.msg).startswith(_STOPPING)
                text = self.format(record)
                if not any(phrase in text for phrase in _REPLACED):
                    self._print(text)
            elif str(record.msg).startswith("Trying to restart job"):
                self._print("        the job is tried again")
            elif str(record.msg).startswith(_NOTHING):
                self._print(self.unrecorded() or f"{_NOTHING}.\n{closing.success(self.study, {})}")
        except Exception:  # as in every handler: an error of the display must not end a run
            self.handleError(record)

    def _find(self, record: Any) -> tuple[runs.Run, str] | None:
        """Return the run and the label of the job of a record; None for a target."""
        if not record.log:
            return None
        folder, label = place(Path(record.log[0]))
        run = self.runs.get(str(folder.relative_to("results")))
        return (run, label) if run is not None and label in run.jobs else None

    def _begin_job(self, record: Any) -> None:
        if match := self._find(record):
            run, label = match
            self.jobs[record.jobid] = run, label, list(record.output)
            run.begin(label)
            if self.live is not None and not record.output:
                self.live.stop()  # a job without outputs prints

    def _finish_job(self, number: int) -> None:
        if number not in self.jobs:
            return
        run, label, outputs = self.jobs[number]
        job = run.jobs[label]
        benchmark = benchmarks.read(Path(run.folder, "benchmarks", f"{label}.tsv"))
        run.end(label, runs.DONE, None if benchmark is None else benchmark.seconds)
        job.result = outcome(job.rule, outputs, self._log(run, label))
        run.save()
        self.durations[run.study].read_again()
        total = sum(len(study_run.jobs) for study_run in self.runs.values())
        done = sum(len(study_run.labels(runs.DONE)) for study_run in self.runs.values())
        count = f"{done:>{len(str(total))}}/{total}"
        self._print(f"{count}  {self._title(run, label):<44}  {duration(job.seconds or 0.0):>8}  {job.result}")
        if self.live is not None and not self.live.is_started and not self.stopped.is_set():
            self.live.start()

    def _fail_job(self, record: Any) -> None:
        match = self._find(record)
        if match is None:
            return self._print(self.format(record))
        run, label = match
        if self.stopping:
            run.end(label, runs.WAITING)
            return self._print(f"stopped  {self._title(run, label)}")
        log = self._log(run, label)
        lines = last_lines(log, _LOG_LINES)
        errors = [line for line in lines if line.startswith("tasklens: ")]
        run.end(label, runs.FAILED, result=(errors or lines or [""])[-1])
        elapsed = duration(run.jobs[label].seconds or 0.0)
        self._print(f"FAILED  {self._title(run, label)}  after {elapsed}; its log {log}:")
        empty = (
            "the failures are printed above"
            if run.jobs[label].rule == "verify"
            else "the job was killed, or did not start"
        )
        for line in lines or [f"(empty: {empty})"]:
            self._print(f"    {line}")

    def _log(self, run: runs.Run, label: str) -> Path:
        return Path(run.folder, "logs", f"{label}.log")

    def _title(self, run: runs.Run, label: str) -> str:
        point = run.study.partition("/")[2]
        return " ".join(filter(None, (point, runs.title(label))))

    def _headline(self) -> str:
        return runs.headline([(run, self.durations[name]) for name, run in self.runs.items()])

    def _running(self) -> list[str]:
        """Describe the running jobs, one line each."""
        return [
            " ".join(filter(None, (name.partition("/")[2], run.describe(label, self.durations[name]))))
            for name, run in self.runs.items()
            for label in run.labels(runs.RUNNING)
        ]

    def _print(self, text: str) -> None:
        self.console.print(Text(text), soft_wrap=True)

    def _every_minute(self) -> None:
        while not self.stopped.wait(_MINUTE_S):
            if self.runs:
                self._print("; ".join([self._headline(), *self._running()]))

    def _bar(self) -> Group:
        if not self.runs:
            return Group()
        grid = Table.grid(padding=(0, 1))
        total = sum(len(run.jobs) for run in self.runs.values())
        done = sum(len(run.labels(runs.DONE)) for run in self.runs.values())
        bar = ProgressBar(total=total, completed=done, width=24)
        grid.add_row(bar, Text(self._headline(), no_wrap=True, overflow="ellipsis"))
        running = self._running()
        lines = [f"  {line}" for line in running[:_SHOWN]]
        lines += [f"  and {len(running) - _SHOWN} more"] if len(running) > _SHOWN else []
        return Group(grid, *(Text(line, no_wrap=True, overflow="ellipsis") for line in lines))
