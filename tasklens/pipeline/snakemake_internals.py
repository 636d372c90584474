"""Uses of Snakemake beyond its documented interface; no other module has any.

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

from tasklens.pipeline.changes import PlannedJob
from tasklens.runtime.job import place

_DEFAULT_HANDLER = "DefaultStreamHandler"  # of the terminal


def configfiles(workflow: Any) -> list[Path]:
    """Return the files of `--configfile`."""
    return [Path(path) for path in workflow.config_settings.configfiles]


def cores(workflow: Any) -> int:
    """Return how many jobs run at once: on cores of this machine, or submitted to a cluster."""
    return workflow.resource_settings.cores or workflow.resource_settings.nodes or 1


def is_dry_run(workflow: Any) -> bool:
    """Return whether jobs are only planned."""
    return workflow.output_settings.dryrun


def is_module(workflow: Any) -> bool:
    """Return whether the workflow is a module of another one."""
    return not workflow.modifier.is_main_snakefile()


def is_main(workflow: Any) -> bool:
    """Return whether this process plans this workflow: it is no job itself, and the workflow no module of another."""
    return workflow.exec_mode == ExecMode.DEFAULT and not is_module(workflow)


def is_quiet(workflow: Any) -> bool:
    """Return whether `--quiet` is given."""
    return bool(workflow.output_settings.quiet)


def planned_jobs(workflow: Any) -> Iterator[PlannedJob]:
    """Yield the jobs that the targets need, but for the targets themselves, in the order of their rules."""
    dag, persistence = workflow.dag, workflow.persistence
    order = {rule.name: k for k, rule in enumerate(workflow.rules)}
    for job in sorted(dag.jobs, key=lambda job: order[job.rule.name]):
        if not job.log:
            continue
        killed = workflow.async_run(persistence.incomplete(job))  # outputs of killed jobs
        records = (ast.literal_eval(text) for path in job.output for text in persistence.params(path) or ())
        folder, label = place(Path(job.log[0]))
        yield PlannedJob(
            study=str(folder.relative_to("results")),
            label=label,
            remains=dag.needrun(job),
            outputs=tuple(str(path) for path in job.output if path not in killed and os.path.exists(path)),
            needs=tuple(place(Path(other.log[0]))[1] for other in dag.dependencies[job] if other.log),
            settings=str(job.params.settings),
            made_with=next((text for text in records if isinstance(text, str) and text.startswith("{")), None),
        )


def take_terminal(handler: logging.Handler, quiet: bool, logger: logging.Logger = logger) -> bool:
    """Let a handler take the place of Snakemake's own for the terminal; return false if a user has chosen another."""
    default = next((known for known in logger.handlers if known.name == _DEFAULT_HANDLER), None)
    if default is not None and not quiet:
        handler.setFormatter(default.formatter)
        logger.removeHandler(default)
    logger.addHandler(handler)
    return default is not None and not quiet


def terminate_safely() -> None:
    """Let SIGTERM end a run after its running jobs, as documented; call it when the scheduler has set its handler.

    The handler of Snakemake takes a lock that the interrupted thread may have, and never gets it (9.27: three of twelve
    runs of short jobs hung). In a thread of its own it waits until the scheduler has released the lock.
    """
    handler: Any = signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGTERM, lambda *arguments: threading.Thread(target=handler, args=arguments).start())


def after_dry_run(text: Callable[[], str]) -> None:
    """Print a text below Snakemake's lines of a dry run, where it is seen."""

    class Last(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if str(record.msg).startswith("This was a dry-run") and (last := text()):
                print(f"\n{last}")

    logger.addHandler(Last())
