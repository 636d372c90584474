"""Read files, and write them atomically: under a temporary name, then renamed."""

import glob
import io
import json
import math
import os
import re
import shutil
import socket
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    """Convert a value of a file to a finite number; text such as 1e-4, which YAML leaves as text, is a number too.

    Raises:
        FileError: the value is not a finite number; the message begins with `where`.
    """
    text = str(value)  # repr of a NumPy number has its type
    if not _NUMBER.fullmatch(text):
        raise FileError(f"{where}: expected a number, found {value!r}")
    if not math.isfinite(float(text)):
        raise FileError(f"{where}: expected a number within the range of float64 (1.8e308), found {value!r}")
    return float(text)


def positive(value: object, where: str) -> float:
    """Convert a value of a file to a positive number as `number` does; raises FileError."""
    result = number(value, where)
    if not result > 0:
        raise FileError(f"{where}: expected a positive number, found {value!r}; correct it")
    return result


def as_path(value: Any, name: str) -> Path:
    """Return the path of a file; raises InputError for a file object, bytes or nothing, with `name` of the argument."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name}: expected the path of a file, got {type(value).__name__}; give its name as text")
    return Path(value)


def as_paths(values: Any, name: str) -> list[Path]:
    """Return the paths of one file or several; raises InputError as `as_path` does."""
    is_one = isinstance(values, str | os.PathLike) or not isinstance(values, Iterable) or hasattr(values, "read")
    return [as_path(value, name) for value in ([values] if is_one else values)]


def read_bytes(path: Path, most: int = 100_000_000) -> bytes:
    """Read a file of at most `most` bytes; raises FileError for a folder, a pipe or a larger file."""
    size = path.stat().st_size
    if not path.is_file():  # reading a pipe would block forever
        raise FileError(f"{path}: is a {'folder' if path.is_dir() else 'pipe or device'}; expected a file")
    if size > most:
        raise FileError(f"{path}: has {size / 1e6:.0f} MB; expected a file of at most {most / 1e6:.0f} MB")
    return path.read_bytes()


def read_yaml(path: Path) -> Any:
    """Read a YAML file that a job wrote, ten times as fast as `yaml_files.read` if libyaml is installed.

    Raises:
        FileError: the file is damaged.
    """
    import yaml

    try:
        content = yaml.load(path.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, ValueError) as error:
        raise damage_error(path, str(error).splitlines()[0]) from None
    if not isinstance(content, dict):
        raise damage_error(path, "not keys and values")
    return content


_NAMES = ("elements", "design", "classifier", "lens", "baseline")  # columns of tables with names of a study


def read_table(path: Path, **options: Any) -> "pandas.DataFrame":
    """Read a CSV file that a job wrote; columns of names are text, also if a name is a number, `nan` or `null`.

    Args:
        options: options of `pandas.read_csv`.

    Raises:
        FileError: the file is cut off, or no table.
    """
    import pandas

    text = path.read_text(encoding="utf-8", errors="replace")
    if not text.endswith("\n"):
        raise damage_error(path, "cut off")
    try:
        table = pandas.read_csv(io.StringIO(text), **options)
        if names := [name for name in _NAMES if name in table]:
            texts = pandas.read_csv(io.StringIO(text), usecols=names, dtype=str, keep_default_na=False)
            return table.assign(**texts)
        return table
    except ValueError as error:  # errors of pandas are ValueErrors too
        raise damage_error(path, f"not a table ({str(error).splitlines()[0]})") from None


def read_json(path: Path) -> Any:
    """Read a JSON file that a job wrote; raises FileError if it is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise damage_error(path, f"not valid JSON ({error})") from None


def damage_error(path: Path, what: str) -> FileError:
    """Return the error for a damaged result file; `what` is wrong with it."""
    return FileError(f"{path}: {what}; delete it and run again")


def temporary_of(path: Path) -> Path:
    """Return the temporary path for `path` that only this process uses."""
    return path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}.part")


def resumable_of(path: Path) -> Path:
    """Return the temporary path for `path` that successive processes share, to continue the file."""
    return path.with_name(f".{path.name}.part")


@contextmanager
def replacing(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path, which is renamed to `path` when the block ends, and removed when it raises.

    A given temporary file remains if the user interrupts the block.

    The file is flushed to disk before it is renamed: even after a power failure it is either complete or absent.
    Temporary files left by killed processes of this machine are removed.

    Args:
        temporary: temporary path; None: that of `temporary_of`.

    Raises:
        OSError: an operation of the block failed; the error names `path` if the system names no file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(path)
    resumable = temporary is not None
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
        raise OSError(error.errno, error.strerror, str(path)) from error  # a failed write, for example on a full disk
    finally:
        if not (resumable and isinstance(sys.exception(), KeyboardInterrupt)):
            temporary.unlink(missing_ok=True)


def remove_abandoned(path: Path) -> None:
    """Remove the temporary files of `path` left by killed processes of this machine."""
    prefix = f".{path.name}.{socket.gethostname()}-"
    for other in path.parent.glob(f"{glob.escape(prefix)}*.part"):
        pid = other.name.removeprefix(prefix).removesuffix(".part")
        if pid.isdigit() and (int(pid) == os.getpid() or not psutil.pid_exists(int(pid))):
            other.unlink(missing_ok=True)


def _synchronise(path: Path, mode: int) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_tensors(path: Path, tensors: Mapping[str, "torch.Tensor"], metadata: Mapping[str, Any]) -> None:
    """Write a safetensors file; metadata is one JSON string, since safetensors orders several entries randomly."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        try:
            save_file(contiguous, temporary, {"json": json.dumps(metadata)})
        except SafetensorError as error:
            raise FileError(f"{path}: cannot be written ({error}); free disk space and run again") from None
        temporary.chmod(path.parent.stat().st_mode & 0o666)  # safetensors lets only the owner read it


@contextmanager
def writing_array(path: Path, shape: tuple[int, ...], begun: bool = False) -> Iterator["numpy.memmap[Any, Any]"]:
    """Yield a writable map of a .npy file of uint8, for arrays larger than memory; only one process may write a file.

    Args:
        begun: continue the temporary file of a killed process, and keep its values.

    Raises:
        FileError: before the block: too little disk space.
    """
    import numpy

    with replacing(path, resumable_of(path)) as temporary:
        if not begun:
            size = math.prod(shape)
            free = shutil.disk_usage(temporary.parent).free  # on a full disk, writing to the map kills the process
            if free < size:
                raise FileError(f"{path}: needs {size / 1e6:.1f} MB, but the disk has {free / 1e6:.1f} MB free")
        array = numpy.lib.format.open_memmap(temporary, "r+" if begun else "w+", "uint8", shape)
        yield array
        array.flush()


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
        raise FileError(f"{path}: not a complete array; remove it ({error})") from error


def read_tensors(path: Path) -> tuple[dict[str, "torch.Tensor"], dict[str, Any]]:
    """Read tensors and metadata of a safetensors file; tensors are memory-mapped, not copied.

    Raises:
        FileError: the file is not complete.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = json.loads((file.metadata() or {}).get("json", "{}"))
    except (SafetensorError, ValueError) as error:
        raise damage_error(path, f"not a complete file of tensors ({error})") from None
    return tensors, metadata


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV; the columns are the keys of all rows, in order of appearance."""
    import csv

    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
