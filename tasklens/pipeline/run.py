"""Execution of one job: the function of its stage, with its checkpoint."""

import gc
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from tasklens.pipeline import job_lock
from tasklens.pipeline.digest import code_digest, digest_of
from tasklens.pipeline.progress_file import progress_file
from tasklens.pipeline.stage import Stage, flatten, results
from tasklens.runtime.files import FileError, Files
from tasklens.study.study import Study


def run(stage: Stage, study: Study, wildcards: Mapping[str, str | int], partial: bool = False) -> Any:
    """Run a job; its checkpoint is removed when its outputs are complete.

    Args:
        partial: in mappings of inputs, take the partial file of a missing one, or leave it out; and add "-partial" to
            the names of the outputs.

    Raises:
        FileError: an input is missing.
        StudyError: a wildcard is no name in the study.
    """
    plan, outputs = stage.plan(study, **wildcards), stage.outputs(study, **wildcards)
    inputs, label = dict(plan.inputs), stage.label.format(**wildcards)
    if partial:
        given = {name: files for name, files in inputs.items() if isinstance(files, Mapping)}
        inputs |= {name: _there(files) for name, files in given.items()}
        outputs = {name: _partial(path) for name, path in outputs.items()}
    missing = [path for path in flatten(inputs) if not path.exists()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise FileError(f"{label}: missing input {missing[0]}{more}; `snakemake` makes what a job needs")
    first = os.environ.get("RANK", "0") == "0"  # of a process group, the first process writes
    reported = progress_file(results(study), label) if first else nullcontext()
    arguments = plan.settings, Files(**inputs), Files(**outputs)
    if not stage.resumable:
        with reported, _imported(stage.function) as function:
            return function(*arguments)
    folder, file = Path(results(study)), label.replace("/", "-", 1)
    key = digest_of(plan.settings.model_dump_json(), code_digest(stage.function), inputs=list(flatten(plan.inputs)))
    lock = job_lock.alone(folder / "locks" / f"{file}.lock", key, outputs.values()) if first else nullcontext(True)
    with lock as work:
        if work:
            with reported, _imported(stage.function) as function:
                checkpoint = _checkpoint(key, folder / "checkpoints" / file)
                function(*arguments, checkpoint)
            if first:
                checkpoint.remove()
    return None


def _partial(path: Path) -> Path:
    """Return the name of a file that is made of a part of its inputs."""
    return path.with_name(path.name.replace(".", "-partial.", 1))


def _there(files: Mapping[Any, Path]) -> dict[Any, Path]:
    """Return the files that exist, or are made of a part of their inputs."""
    found = {key: path if path.exists() else _partial(path) for key, path in files.items()}
    return {key: path for key, path in found.items() if path.exists()}


@contextmanager
def _imported(function: str) -> Iterator[Callable[..., Any]]:
    """Import the function `package.module.function`, and yield it.

    Garbage is not collected while it is imported, nor looked for among what was imported while it runs: collections of
    hundreds of thousands of objects, none of them garbage, take a fifth of the time of an import.
    """
    module, _, name = function.rpartition(".")
    gc.disable()
    try:
        found = getattr(import_module(module), name)
    finally:
        gc.enable()
    gc.freeze()
    try:
        yield found
    finally:
        gc.unfreeze()


def _checkpoint(digest: str, name: Path) -> Any:
    """Return the checkpoint of a job; outdated checkpoints of the same job are removed."""
    from tasklens.runtime.checkpoints import Checkpoint

    path = name.with_name(f"{name.name}-{digest}.pt")
    for other in name.parent.glob(f"{name.name}-{16 * '[0-9a-f]'}.pt"):
        if other != path:
            other.unlink(missing_ok=True)  # other processes of the group may remove it first
    return Checkpoint(path)
