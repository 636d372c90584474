"""Uses of the objects of Snakemake beyond its documented interface; no other module has any.

The argument `workflow` is the variable of that name in a Snakefile.
"""

import ast
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from snakemake.logging import logger
from snakemake.settings.types import ExecMode

from tasklens.runtime.job import place
from tasklens.study.run.changes import PlannedJob
from tasklens.study.run.digest import is_digest

_DEFAULT_HANDLER = "DefaultStreamHandler"  # of the terminal
_DEFAULT_RATE = (100, 1)  # jobs, seconds
_LAST_OF_DRY_RUN = ("This was a dry-run", "Nothing to be done")


def configfiles(workflow: Any) -> list[Path]:
    """Return the files of `--configfile`."""
    return [Path(path) for path in workflow.config_settings.configfiles]


def cores(workflow: Any) -> int:
    """Return how many jobs run at once: on cores of this machine, or submitted to a cluster."""
    return workflow.resource_settings.cores or workflow.resource_settings.nodes or 1


def is_dry_run(workflow: Any) -> bool:
    """Return whether jobs are only planned."""
    return workflow.output_settings.dryrun


def is_touch(workflow: Any) -> bool:
    """Return whether outputs are only recorded as up to date (`--touch`)."""
    return workflow.touch


def is_module(workflow: Any) -> bool:
    """Return whether the workflow is a module of another one."""
    return not workflow.modifier.is_main_snakefile()


def is_main(workflow: Any) -> bool:
    """Return whether this process plans this workflow: the process is not a job, and the workflow not a module."""
    return workflow.exec_mode == ExecMode.DEFAULT and not is_module(workflow)


def is_quiet(workflow: Any) -> bool:
    """Return whether `--quiet` is set."""
    return bool(workflow.output_settings.quiet)


def planned_jobs(workflow: Any) -> Iterator[PlannedJob]:
    """Yield the jobs that the targets need, except the targets themselves, in the order of their rules."""
    dag, persistence = workflow.dag, workflow.persistence
    order = {rule.name: k for k, rule in enumerate(workflow.rules)}
    for job in sorted(dag.jobs, key=lambda job: order[job.rule.name]):
        if not job.log:
            continue
        incomplete = workflow.async_run(persistence.incomplete(job))  # outputs of killed jobs
        records = [ast.literal_eval(text) for path in job.output for text in persistence.params(path) or ()]
        texts = [text for text in records if isinstance(text, str)]
        folder, label = place(Path(job.log[0]))
        yield PlannedJob(
            study=str(folder.relative_to("results")),
            label=label,
            remains=dag.needrun(job),
            outputs=tuple(str(path) for path in job.output if path not in incomplete and os.path.exists(path)),
            needs=tuple(place(Path(other.log[0]))[1] for other in dag.dependencies[job] if other.log),
            settings=str(job.params.settings),
            code=job.params.code,
            made_with=next((text for text in texts if text.startswith("{")), None),
            made_by=next((text for text in texts if is_digest(text)), None),
            priority=job.priority if dag.needrun(job) else 0.0,
        )


def take_terminal(handler: logging.Handler, quiet: bool, logger: logging.Logger = logger) -> bool:
    """Replace Snakemake's handler for the terminal; return false if the user has chosen another one, or `quiet`."""
    default = next((candidate for candidate in logger.handlers if candidate.name == _DEFAULT_HANDLER), None)
    if default is not None and not quiet:
        handler.setFormatter(default.formatter)
        logger.removeHandler(default)
    logger.addHandler(handler)
    return default is not None and not quiet


def terminate_safely() -> None:
    """Let SIGTERM end a run after its running jobs, as documented; call it after the scheduler has set its handler.

    Snakemake's handler takes a lock. If the interrupted thread holds that lock, the handler waits forever (9.27: three
    of twelve runs of short jobs hung). In a separate thread it waits until the scheduler has released the lock.
    """
    handler: Any = signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGTERM, lambda *arguments: threading.Thread(target=handler, args=arguments).start())


def limit_no_rate(workflow: Any) -> None:
    """Switch off Snakemake's default limit of 100 jobs a second; call it at the start of a run.

    With a limit the scheduler (9.27) evaluates all ready jobs once more a second for every job that has ended: a tenth
    of a core after 150 jobs. A limit of the user stays.
    """
    limiter = workflow.scheduler.job_rate_limiter
    if limiter is not None and (limiter.max_jobs, limiter.timespan) == _DEFAULT_RATE:
        workflow.scheduler.job_rate_limiter = None


def after_dry_run(text: Callable[[], str]) -> None:
    """Print a text below Snakemake's last line of a dry run, so that users see it."""

    class Last(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if str(record.msg).startswith(_LAST_OF_DRY_RUN) and (last := text()):
                print(f"\n{last}")

    logger.addHandler(Last())
