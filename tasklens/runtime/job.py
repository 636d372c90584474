"""Execution of one job of the workflow: its typed function, called with settings and files."""

import ctypes
import gc
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter

from tasklens.runtime import locks
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import remove_abandoned
from tasklens.runtime.progress import progress_file

Paths = str | Sequence[str]
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of mallopt(3)


def run(
    function: str, settings: str, code: str, inputs: Mapping[str, Paths], outputs: Mapping[str, str], log: Path
) -> None:
    """Call the function of a job; its checkpoint is removed when the outputs are complete.

    Args:
        function: `package.module.function`; its parameters are named like the settings and the files; a parameter whose
            type is a data class gets the files named like its fields; a parameter `checkpoint` lets a killed job
            resume.
        settings: JSON of the settings by parameter, or of the object for a parameter `settings`.
        code: digest of the code of the function.
        inputs: input files by name; one, several, or none if the parameter may be None. A file that no rule waits for
            may be missing.
        outputs: output files by name.
        log: results/<study>/logs/<label>.log.
    """
    folder, label = place(log)
    name = label.replace("/", "-", 1)
    key = _digest(function, settings, code, *_states(inputs))
    checkpoint = _checkpoint_path(key, folder / "checkpoints" / name)
    lock = locks.alone(folder / "locks" / f"{name}.lock", key, [Path(path) for path in outputs.values()])
    with lock if outputs else nullcontext(True) as work:
        if work:
            with progress_file(str(folder), label):
                _call(function, settings, inputs, outputs, checkpoint)
        checkpoint.unlink(missing_ok=True)
        remove_abandoned(checkpoint)


def _call(
    function: str, settings: str, inputs: Mapping[str, Paths], outputs: Mapping[str, str], checkpoint: Path
) -> None:
    module, _, name = function.rpartition(".")
    # The garbage collector is off during the import, and skips the imported objects while the function runs: to search
    # hundreds of thousands of objects, none of them garbage, takes a fifth of the time of an import.
    gc.disable()
    try:
        call = getattr(import_module(module), name)
    finally:
        gc.enable()
    gc.freeze()
    kinds = get_type_hints(call)
    parameters, others = list(signature(call).parameters), dict(inputs)
    values = json.loads(settings)
    if "settings" in parameters:
        values = {"settings": values}
    arguments = {  # without computed fields
        name: TypeAdapter(kinds[name]).validate_python(value, extra="ignore") for name, value in values.items()
    }
    arguments |= _files(parameters, kinds, others)
    if others:
        raise TypeError(f"{function} has no parameter {', '.join(others)}")
    arguments |= {name: Path(path) for name, path in outputs.items()}
    if "checkpoint" in parameters:
        arguments["checkpoint"] = kinds["checkpoint"](checkpoint)
    try:
        call(**arguments)
    finally:
        gc.unfreeze()


def _files(names: Iterable[str], kinds: Mapping[str, Any], inputs: dict[str, Paths]) -> dict[str, Any]:
    """Return the input files by parameter, those of a data class as one object; others remain in `inputs`."""
    files: dict[str, Any] = {}
    for name in names:
        if is_dataclass(kind := kinds[name]) and isinstance(kind, type):
            files[name] = kind(**_files([field.name for field in fields(kind)], get_type_hints(kind), inputs))
        elif name in inputs:
            files[name] = _paths(inputs.pop(name), kind)
    return files


def run_program(program: Callable[[], object], log: Path | None) -> NoReturn:
    """Run a program, and end the process with its `exit_status`.

    Freed memory stays with the process. It ends without freeing every object, since that takes longer than some jobs;
    all files are complete by then. Waiting threads sleep: on cores that other programs use, they delay the others if
    they spin, and a tolerance analysis takes ten times as long.

    Args:
        log: file for standard error; None: standard error stays as it is.
    """
    keep_memory()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch is imported
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "w") as file:
            os.dup2(file.fileno(), sys.stderr.fileno())
    status = exit_status(program)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def exit_status(program: Callable[[], object]) -> int:
    """Run a program; return 2 for a user error, which is printed in one line, the status of an exit, else 0."""
    try:
        program()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except Exception as error:
        message = user_error(error)
        if message is None:
            raise
        print(f"tasklens: {message}", file=sys.stderr)
        return 2
    return 0


def user_error(error: Exception) -> str | None:
    """Return the message for an error of the input or of the machine; None for any other error."""
    if isinstance(error, InputError | FloatingPointError):
        return str(error)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    kinds = {kind.__name__ for kind in type(error).__mro__}  # by name, so that torch is not imported for its error
    if {"MemoryError", "OutOfMemoryError"} & kinds or "can't allocate memory" in str(error):
        return f"not enough memory ({error}); run fewer jobs at once, or lower batch_size"
    return None


def place(log: Path) -> tuple[Path, str]:
    """Return the results folder of a study and the label of a job, from the path of the job's log."""
    parts = log.with_suffix("").parts
    logs = parts.index("logs", 2)  # after results/<study>
    return Path(*parts[:logs]), "/".join(parts[logs + 1 :])


def _paths(paths: Paths, kind: Any) -> Path | list[Path] | None:
    """Convert input files to the type of their parameter: several paths, one, or None."""
    files = [Path(path) for path in ([paths] if isinstance(paths, str) else paths)]
    if get_origin(kind) is Sequence:
        return files
    if len(files) == 1 or (not files and type(None) in get_args(kind)):
        return files[0] if files else None
    raise TypeError(f"expected one file, got {len(files)}")


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


def keep_memory() -> None:
    """Keep freed memory in the process.

    Otherwise page faults of new arrays take a fifth of the time of a training with 64-pixel images, and half of the
    time of an evaluation or a design with 224-pixel images.
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
            other.unlink(missing_ok=True)
    return path
