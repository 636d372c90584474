"""Atomic writing of files, under a temporary name that is renamed; and reading."""

import glob
import io
import json
import math
import os
import re
import shutil
import socket
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from tasklens.runtime.errors import InputError

if TYPE_CHECKING:
    import numpy
    import pandas
    import torch


class FileError(InputError):
    """A file with invalid content; the message names it and says what was expected."""


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def number(value: object, where: str) -> float:
    """Convert a value of a file to a finite number, also text such as 1e-4, which YAML does not parse as a number.

    Raises:
        FileError: another value; the message begins with `where`.
    """
    text = value if isinstance(value, str) else repr(value)
    if not _NUMBER.fullmatch(text):
        raise FileError(f"{where}: expected a number, found {value!r}")
    if not math.isfinite(float(text)):
        raise FileError(f"{where}: expected a number within the range of float64 (1.8e308), found {value!r}")
    return float(text)


def positive(value: object, where: str) -> float:
    """Convert a value of a file to a positive number as `number` does; raises FileError."""
    found = number(value, where)
    if not found > 0:
        raise FileError(f"{where}: expected a positive number, found {value!r}; correct it")
    return found


def read_bytes(path: Path, most: int = 100_000_000) -> bytes:
    """Read a file of at most `most` bytes; raises FileError for a folder, a pipe or a larger file."""
    size = path.stat().st_size
    if not path.is_file():  # to read a pipe would take for ever
        raise FileError(f"{path}: is a {'folder' if path.is_dir() else 'pipe or device'}; expected a file")
    if size > most:
        raise FileError(f"{path}: has {size / 1e6:.0f} MB; expected a file of at most {most / 1e6:.0f} MB")
    return path.read_bytes()


def read_yaml(path: Path) -> Any:
    """Read a YAML file that a job wrote, ten times as fast as `yaml_files.read` where libyaml is there.

    Raises:
        FileError: it is damaged.
    """
    import yaml

    try:
        content = yaml.load(path.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, ValueError) as error:
        raise damaged(path, str(error).splitlines()[0]) from None
    if not isinstance(content, dict):
        raise damaged(path, "no keys and values")
    return content


def read_table(path: Path, **options: Any) -> "pandas.DataFrame":
    """Read a CSV file that a job wrote; `options` are of `pandas.read_csv`.

    Raises:
        FileError: it is cut off, or no table.
    """
    import pandas

    text = path.read_text(encoding="utf-8", errors="replace")
    if not text.endswith("\n"):
        raise damaged(path, "cut off")
    try:
        return pandas.read_csv(io.StringIO(text), **options)
    except ValueError as error:  # of pandas too
        raise damaged(path, f"no table ({str(error).splitlines()[0]})") from None


def read_json(path: Path) -> Any:
    """Read a JSON file that a job wrote; raises FileError if it is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise damaged(path, f"no JSON ({error})") from None


def damaged(path: Path, what: str) -> FileError:
    """Return the error of a result that is not what a job writes."""
    return FileError(f"{path}: {what}; delete it and run again")


def temporary_of(path: Path) -> Path:
    """Return the temporary path at which this process writes `path`, and no other one."""
    return path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}.part")


def resumable_of(path: Path) -> Path:
    """Return the temporary path at which `path` is written by one process after the other."""
    return path.with_name(f".{path.name}.part")


@contextmanager
def replacing(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path, which is renamed to `path` when the block ends, and removed when it raises.

    The file is on the disk before it has its name, so that it is complete or absent after a loss of power too.
    Temporary files that killed processes of this machine have left are removed.

    Args:
        temporary: in place of a name of this process alone.

    Raises:
        OSError: what an operation of the block raises; it names `path` where the system names none.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(path)
    temporary = temporary or temporary_of(path)
    try:
        yield temporary
        _synchronise(temporary, os.O_RDWR)
        os.replace(temporary, path)
        if os.name == "posix":  # elsewhere folders cannot be opened
            _synchronise(path.parent, os.O_RDONLY)
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # of writing: no space is left, for instance
    finally:
        temporary.unlink(missing_ok=True)


def remove_abandoned(path: Path) -> None:
    """Remove the temporary files of `path` that killed processes of this machine have left."""
    begin = f".{path.name}.{socket.gethostname()}-"
    for other in path.parent.glob(f"{glob.escape(begin)}*.part"):
        number = other.name.removeprefix(begin).removesuffix(".part")
        if number.isdigit() and (int(number) == os.getpid() or not psutil.pid_exists(int(number))):
            other.unlink(missing_ok=True)


def _synchronise(path: Path, mode: int) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    opened = os.open(path, mode)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_tensors(path: Path, tensors: Mapping[str, "torch.Tensor"], metadata: Mapping[str, Any]) -> None:
    """Write a safetensors file; metadata are one JSON text, since the order of several entries is random."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        try:
            save_file(contiguous, temporary, {"json": json.dumps(metadata)})
        except SafetensorError as error:
            raise FileError(f"{path}: cannot be written ({error}); make room, and run again") from None
        temporary.chmod(path.parent.stat().st_mode & 0o666)  # safetensors shuts out everybody but the owner


@contextmanager
def writing_array(
    path: Path, shape: tuple[int, ...], dtype: str, begun: bool = False
) -> Iterator["numpy.memmap[Any, Any]"]:
    """Yield a mapped array of a .npy file to write, for arrays larger than memory.

    Args:
        begun: continue the temporary file of a killed process, and keep its values.

    Raises:
        FileError: too little disk space, or another process that writes it, before the block.
    """
    import numpy

    with _alone(path), replacing(path, resumable_of(path)) as temporary:
        if not begun:
            size = numpy.dtype(dtype).itemsize * math.prod(shape)
            free = shutil.disk_usage(temporary.parent).free  # on a full disk, writing to the map kills the process
            if free < size:
                raise FileError(f"{path}: needs {size / 1e6:.1f} MB, the disk has {free / 1e6:.1f} MB free")
        mapped = numpy.lib.format.open_memmap(temporary, "r+" if begun else "w+", dtype, shape)
        yield mapped
        mapped.flush()


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Let no other process write `path` while the block runs; raises FileError where one does."""
    from filelock import FileLock

    from tasklens.runtime.locks import acquire

    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path.with_name(f".{path.name.lstrip('.')}.lock"))
    if not acquire(lock):
        raise FileError(f"{path}: another process is writing it; wait for it, or end it")
    try:
        yield
    finally:
        lock.release()


def map_array(path: Path) -> "torch.Tensor":
    """Map the array of a .npy file as a read-only tensor, for arrays larger than memory.

    Raises:
        FileError: the file is not complete.
    """
    import numpy
    import torch

    try:
        array = numpy.lib.format.open_memmap(path, "r")
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # torch warns that the array is read-only
            return torch.from_numpy(array)
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise FileError(f"{path}: no complete array; remove it ({error})") from error


def read_tensors(path: Path) -> tuple[dict[str, "torch.Tensor"], dict[str, Any]]:
    """Read tensors and metadata of a safetensors file; tensors are mapped, not copied.

    Raises:
        FileError: the file is not complete.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = json.loads((file.metadata() or {}).get("json", "{}"))
    except (SafetensorError, ValueError) as error:
        raise damaged(path, f"no complete file of tensors ({error})") from None
    return tensors, metadata


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV; the columns are the keys of all rows, in order of appearance."""
    import csv

    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_if_changed(path: str | Path, text: str) -> None:
    """Write a text file unless it already has this text."""
    path = Path(path)
    if not path.exists() or path.read_text() != text:
        write_text(path, text)
