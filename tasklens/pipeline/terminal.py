"""What a run of the workflow shows: a line for each job that ends, and a bar with what runs now.

Snakemake reports to a logger of Python; a handler of our own takes the place of its handler for the terminal, and keeps
the state of the run (`pipeline.runs`). Snakemake's file below .snakemake/log has everything as ever. Without a terminal
there is a line a minute in place of the bar.
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

from tasklens.pipeline import closing, runs
from tasklens.pipeline.forecast import duration, durations_of, seconds_of
from tasklens.pipeline.outcome import last_lines, outcome
from tasklens.pipeline.stage import STAGES, results
from tasklens.study.study import Study

_MINUTE_S = 60.0
_SHOWN = 8  # running jobs below the bar
_LOG_LINES = 12  # of a failed job
_DEFAULT_HANDLER = "DefaultStreamHandler"  # Snakemake's name
_NOTHING = "Nothing to be done"
_TOLD = ("Terminating processes", "Will exit after", "Unlock")
_KNOWN = (
    "Exiting because a job execution failed",
    "At least one job did not complete",
    "non-zero exit status",
)  # said here in other words


class Terminal(logging.Handler):
    """Handler of Snakemake's log records; it prints nothing where the user has chosen another logger or `--quiet`."""

    def __init__(self, study: Study, logger: logging.Logger, quiet: bool):
        super().__init__()
        self.study, self.durations = study, durations_of(study)
        self.run: runs.Run | None = None
        self.live: Live | None = None
        self.stopped = threading.Event()
        self.jobs: dict[int, tuple[str, Mapping[str, Any]]] = {}  # label and wildcards by Snakemake's number
        default = next((handler for handler in logger.handlers if handler.name == _DEFAULT_HANDLER), None)
        self.console = Console(stderr=True, quiet=quiet or default is None, highlight=False)
        if default is not None and not quiet:
            self.setFormatter(default.formatter)
            logger.removeHandler(default)
        logger.addHandler(self)

    def begin(self, jobs: Mapping[str, str], cores: int) -> None:
        """Begin to show a run.

        Args:
            jobs: stage of each job by its label.
            cores: number of jobs at a time.
        """
        self.run = runs.Run(self.study.name, results(self.study), cores, {k: runs.Job(v) for k, v in jobs.items()})
        self.run.save()
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
        """End to show the run."""
        self.stopped.set()
        if self.live is not None:
            self.live.stop()
        if self.run is not None and self.run.ended is None:
            self.run.finish()

    def close(self) -> None:
        """Leave the terminal as it was, however the run ended."""
        self.end()
        super().close()

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record of Snakemake, or note what it says of a job."""
        try:
            event = str(getattr(record, "event", "") or "")
            if event == "job_info":
                self._begin_job(record)
            elif event == "job_finished":
                self._finish_job(record.job_id)  # type: ignore[attr-defined]
            elif event == "job_error":
                self._fail_job(record)
            elif record.levelno >= logging.WARNING or str(record.msg).startswith(_TOLD):
                text = self.format(record)
                if not any(known in text for known in _KNOWN):
                    self._print(text)
            elif str(record.msg).startswith("Trying to restart job"):
                self._print("        it is tried again")
            elif str(record.msg).startswith(_NOTHING):
                self._print(f"{_NOTHING}.\n{closing.success(self.study, None)}")
        except Exception:  # as every handler does: what cannot be shown must not end a run
            self.handleError(record)

    def _begin_job(self, record: Any) -> None:
        label = runs.label_of(record.log, results(self.study))
        if self.run is None or label not in self.run.jobs:
            return
        self.jobs[record.jobid] = label, dict(record.wildcards)
        self.run.begin(label)
        if self.live is not None and not STAGES[self.run.jobs[label].stage].patterns:
            self.live.stop()  # it prints

    def _finish_job(self, number: int) -> None:
        if self.run is None or number not in self.jobs:
            return
        label, wildcards = self.jobs[number]
        stage, log = self.run.jobs[label].stage, self._log(label)
        self.run.end(label, runs.DONE, seconds_of(Path(results(self.study), "benchmarks", f"{label}.tsv")))
        self.run.jobs[label].result = outcome(self.study, stage, wildcards, log)
        self.run.save()
        self.durations = durations_of(self.study)
        job = self.run.jobs[label]
        done = len(self.run.labels(runs.DONE))
        count = f"{done:>{len(str(len(self.run.jobs)))}}/{len(self.run.jobs)}"
        self._print(f"{count}  {runs.title(label):<44}  {duration(job.seconds or 0.0):>8}  {job.result}")
        if self.live is not None and not self.live.is_started and not self.stopped.is_set():
            self.live.start()

    def _fail_job(self, record: Any) -> None:
        label = runs.label_of(record.log, results(self.study))
        if self.run is None or label not in self.run.jobs:
            return self._print(self.format(record))
        log = self._log(label)
        lines = last_lines(log, _LOG_LINES)
        self.run.end(label, runs.FAILED, result=lines[-1] if lines else "")
        self._print(
            f"FAILED  {runs.title(label)}  after {duration(self.run.jobs[label].seconds or 0.0)}; its log {log}:"
        )
        for line in lines or ["(empty: the job was killed, or did not start)"]:
            self._print(f"    {line}")

    def _log(self, label: str) -> Path:
        return Path(results(self.study), "logs", f"{label}.log")

    def _print(self, text: str) -> None:
        self.console.print(Text(text), soft_wrap=True)

    def _every_minute(self) -> None:
        while not self.stopped.wait(_MINUTE_S):
            if self.run is not None:
                running = "; ".join(self.run.describe(each, self.durations) for each in self.run.labels(runs.RUNNING))
                self._print(f"{self.run.headline(self.durations)}; {running}")

    def _bar(self) -> Group:
        if self.run is None:
            return Group()
        grid = Table.grid(padding=(0, 1))
        done = len(self.run.labels(runs.DONE))
        bar = ProgressBar(total=len(self.run.jobs), completed=done, width=24)
        grid.add_row(bar, Text(self.run.headline(self.durations), no_wrap=True, overflow="ellipsis"))
        running = self.run.labels(runs.RUNNING)
        lines = [f"  {self.run.describe(label, self.durations)}" for label in running[:_SHOWN]]
        lines += [f"  and {len(running) - _SHOWN} more"] if len(running) > _SHOWN else []
        return Group(grid, *(Text(line, no_wrap=True, overflow="ellipsis") for line in lines))


def after_dry_run(logger: logging.Logger, say: Callable[[], str | None]) -> None:
    """Print what `say` returns, if anything, below Snakemake's lines of a dry run, where it is seen."""

    class Last(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if str(record.msg).startswith("This was a dry-run") and (text := say()):
                print(f"\n{text}")

    logger.addHandler(Last())
