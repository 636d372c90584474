"""`tasklens run STAGE STUDY ...`: one job of a study; the commands are made from the declared stages.

    tasklens run design config/config.yaml doublet-tasklens --seed 0

Files are read and written below results/<study name>/.
"""

from collections.abc import Callable
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any

import typer

from tasklens.pipeline import kept_studies, report_jobs
from tasklens.pipeline.partial import prepare
from tasklens.pipeline.run import run
from tasklens.pipeline.stage import SEED, STAGES, Stage, study_file
from tasklens.runtime.errors import InputError
from tasklens.study.loading import at_points, load
from tasklens.study.names import SHARP
from tasklens.study.study import TableName

_HELP = {
    "study": "Study file (YAML).",
    "lens": f"Name of a lens; {SHARP} for the sharp images, where a classifier follows.",
    "measured_name": "Name of a classifier, with -restored on restored captures.",
    "table": "One of the paper's tables.",
    "classifier": "Name of a classifier.",
    "elements": "Name of elements, such as doublet.",
    "ablation": "Name of an ablation.",
}
_KINDS = {"table": TableName}


def app() -> typer.Typer:
    """Return the group of the commands of all declared stages."""
    group = typer.Typer(no_args_is_help=True)
    group.callback()(lambda: None)  # a group, whatever the number of its commands
    for stage in STAGES.values():
        group.command(stage.name.replace("_", "-"), help=stage.plan.__doc__)(_command(stage))
    return group


def _command(stage: Stage) -> Callable[..., None]:
    """Return the command of a stage: its wildcards are arguments, the seed and `--partial` options."""

    def command(study: Path, partial: bool = False, plan: str | None = None, **wildcards: Any) -> None:
        found = load(study)
        if stage is report_jobs.sweep and not found.sweep:
            raise InputError(f"{study}: has no sweep, of which this would make the table")
        if stage is not report_jobs.sweep and found.sweep:
            points = ", ".join(study_file(each) for each in at_points(found))
            raise InputError(f"{study}: has a sweep; expected the file of one of its points: {points}")
        if wildcards.get(SEED, 0) is None:
            wildcards[SEED] = found.seeds[0]
        if plan is not None:
            found = kept_studies.find(stage, found, wildcards, plan)
        if partial and stage is report_jobs.report:
            prepare(found)
        if status := run(stage, found, wildcards, partial):
            raise typer.Exit(status)

    parameters = [
        _argument("study", Path),
        *(_argument(name, _KINDS.get(name, str)) for name in stage.wildcards if name != SEED),
    ]
    if SEED in stage.wildcards:
        parameters.append(_option(SEED, int | None, None, "By default the first seed of the study."))
    parameters.append(_option("plan", str | None, None, "Digest of the settings that a rule gives its job."))
    if stage in (report_jobs.table, report_jobs.report):
        words = f"Write <{stage.name}>-partial, of what is there."
        parameters.append(_option("partial", bool, False, words, "--partial"))
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # which typer reads
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def _argument(name: str, kind: Any) -> Parameter:
    annotation = Annotated[kind, typer.Argument(help=_HELP.get(name), show_default=False)]
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=annotation)


def _option(name: str, kind: Any, default: Any, help: str, *declarations: str) -> Parameter:
    annotation = Annotated[kind, typer.Option(*declarations, help=help, show_default=False)]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
