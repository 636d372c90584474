"""Running one job: its stage's function, with a checkpoint made of the same settings and inputs."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from tasklens.pipeline.digest import STAGES as MODULES
from tasklens.pipeline.digest import code_digest
from tasklens.pipeline.stage import Job, Stage, flatten
from tasklens.runtime.files import FileError


def stage_function(stage: Stage) -> Callable[..., Any]:
    """The function in `pipeline.stages` that does the work of a stage."""
    modules = (import_module(name) for name in MODULES)
    return next(getattr(module, stage.function) for module in modules if hasattr(module, stage.function))


def run(stage: Stage, job: Job) -> Any:
    """Do the work of a job; its checkpoint is removed when its outputs are complete.

    Raises:
        FileError: an input is missing.
    """
    missing = [path for path in flatten(vars(job.inputs)) if not Path(path).exists()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise FileError(f"{job.name}: missing input {missing[0]}{more}; `snakemake` makes what a job needs")
    function = stage_function(stage)
    if not stage.resumable:
        return function(job.settings, job.inputs, job.outputs)
    checkpoint = _checkpoint(stage, job)
    function(job.settings, job.inputs, job.outputs, checkpoint)
    checkpoint.remove()


def _checkpoint(stage: Stage, job: Job) -> Any:
    """That of the job; what a job of its name has left that computed something else, is removed."""
    from tasklens.runtime.checkpoints import Checkpoint, key

    files = [Path(path) for path in flatten(vars(job.inputs))]
    path = Path(f"{job.checkpoint}-{key(job.settings.model_dump_json(), code_digest(stage.function), inputs=files)}.pt")
    for other in path.parent.glob(f"{Path(job.checkpoint).name}-{16 * '[0-9a-f]'}.pt"):
        if other != path:
            other.unlink(missing_ok=True)  # several processes that train together look here
    return Checkpoint(path)
