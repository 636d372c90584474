"""Execution of one job of the workflow: its typed function, called with settings and files."""

import ctypes
import gc
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from tasklens.runtime import job_lock
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import remove_abandoned
from tasklens.runtime.progress_file import progress_file

Paths = str | Sequence[str]
JOB = "settings of a job"  # context of their validation
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of mallopt(3)


def run(
    function: str,
    settings: str,
    code: str,
    inputs: Mapping[str, Paths],
    outputs: Mapping[str, str],
    log: Path,
    group: Sequence[str] = (),
) -> None:
    """Call the function of a job; a checkpoint that it takes is removed when the outputs are complete.

    Args:
        function: `package.module.function`; its first parameter is the settings, the others are named as the files, and
            `checkpoint` if a killed job is resumed.
        settings: JSON of the settings; their class is the annotation of the first parameter.
        code: digest of the code of the function.
        inputs: input files by name; one, several, or none if the parameter may be None. A file that no rule waits for
            may be missing.
        outputs: output files by name.
        log: results/<study>/logs/<label>.log.
        group: command that starts a process group, whose processes call this function without it.
    """
    folder, label = place(log)
    name = label.replace("/", "-", 1)
    key = _digest(function, settings, code, *_states(inputs))
    checkpoint = _checkpoint_path(key, folder / "checkpoints" / name)
    if "RANK" in os.environ:  # a process of a group: the one that started it has the lock, the first one reports
        with progress_file(str(folder), label) if os.environ["RANK"] == "0" else nullcontext():
            _call(function, settings, inputs, outputs, checkpoint)
        return
    lock = job_lock.alone(folder / "locks" / f"{name}.lock", key, [Path(path) for path in outputs.values()])
    with lock if outputs else nullcontext(True) as work:
        if work and group:
            if status := subprocess.run(group, env=os.environ | {"OMP_NUM_THREADS": "1"}).returncode:
                raise SystemExit(status)
        elif work:
            with progress_file(str(folder), label):
                _call(function, settings, inputs, outputs, checkpoint)
        checkpoint.unlink(missing_ok=True)
        remove_abandoned(checkpoint)


def _call(
    function: str, settings: str, inputs: Mapping[str, Paths], outputs: Mapping[str, str], checkpoint: Path
) -> None:
    with _imported(function) as call:
        kinds = get_type_hints(call)
        parameters = list(signature(call).parameters)
        typed = kinds[parameters[0]].model_validate_json(settings, context=JOB)
        arguments: dict[str, Any] = {name: _paths(paths, kinds[name]) for name, paths in inputs.items()}
        arguments |= {name: Path(path) for name, path in outputs.items()}
        if "checkpoint" in parameters:
            arguments["checkpoint"] = kinds["checkpoint"](checkpoint)
        call(typed, **arguments)


@contextmanager
def reporting_errors(log: Path | None) -> Iterator[None]:
    """End the program after the block: status 2 and one line for a user error, else 0; with `log` for standard error.

    It keeps freed memory, and ends without freeing every object, which takes longer than some jobs; all files are
    complete then.
    """
    _keep_memory()
    if log is not None and "RANK" not in os.environ:  # a process of a group has the log of the one that started it
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "w") as file:
            os.dup2(file.fileno(), sys.stderr.fileno())
    status = 0
    try:
        yield
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except Exception as error:
        message = user_error(error)
        if message is None:
            raise
        print(f"tasklens: {message}", file=sys.stderr)
        status = 2
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def user_error(error: Exception) -> str | None:
    """Return what to tell a user of an error that is of the input or of the machine; None for all others."""
    if isinstance(error, InputError | FloatingPointError):
        return str(error)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    kinds = {kind.__name__ for kind in type(error).__mro__}  # Python's, torch's, or that of a GPU; without torch
    if {"MemoryError", "OutOfMemoryError"} & kinds or "can't allocate memory" in str(error):
        return f"not enough memory ({error}); run fewer jobs at once, or lower batch_size"
    return None


def place(log: Path) -> tuple[Path, str]:
    """Return the folder of the results of a study, and the label of a job, from its log."""
    parts = log.with_suffix("").parts
    logs = parts.index("logs", 2)  # behind results/<study>
    return Path(*parts[:logs]), "/".join(parts[logs + 1 :])


def _paths(paths: Paths, kind: Any) -> Path | list[Path] | None:
    """Return input files as the annotation of their parameter has them: several, one, or None."""
    listed = [Path(path) for path in ([paths] if isinstance(paths, str) else paths)]
    if get_origin(kind) is Sequence:
        return listed
    if len(listed) == 1 or (not listed and type(None) in get_args(kind)):
        return listed[0] if listed else None
    raise TypeError(f"expected one file, got {len(listed)}")


def _states(inputs: Mapping[str, Paths]) -> Iterator[str]:
    """Identify input files by size and modification time, since images can be hundreds of gigabytes."""
    for paths in inputs.values():
        for path in [paths] if isinstance(paths, str) else paths:
            try:
                status = os.stat(path)
                yield f"{path} {status.st_size} {status.st_mtime_ns}"
            except FileNotFoundError:
                yield f"{path} missing"


def _digest(*parts: str) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


@contextmanager
def _imported(function: str) -> Iterator[Callable[..., Any]]:
    """Import the function `package.module.function`, and yield it.

    Garbage is not collected while it is imported, nor looked for among what was imported while it runs: collections of
    hundreds of thousands of objects, none of them garbage, take a fifth of the time of an import.
    """
    module, _, name = function.rpartition(".")
    gc.disable()
    try:
        call = getattr(import_module(module), name)
    finally:
        gc.enable()
    gc.freeze()
    try:
        yield call
    finally:
        gc.unfreeze()


def _keep_memory() -> None:
    """Let freed memory stay with the process.

    Page faults of new arrays otherwise take a fifth of the time of a training with images of 64 pixels, and half of
    that of an evaluation or a design with 224.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):  # glibc
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _checkpoint_path(digest: str, name: Path) -> Path:
    """Return the path of the checkpoint of a job; outdated checkpoints of the same job are removed."""
    path = name.with_name(f"{name.name}-{digest}.pt")
    for other in name.parent.glob(f"{name.name}-{16 * '[0-9a-f]'}.pt"):
        if other != path:
            other.unlink(missing_ok=True)  # other processes of the group may remove it first
    return path
