"""Files that are complete or absent: everything is written under a temporary name and renamed."""

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


class FileError(ValueError):
    """A file that does not hold what it should; the message names it and says what was expected."""


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def number(value: object, where: str) -> float:
    """A finite number of a file, also where YAML has taken it for text, such as 1e-4.

    Raises:
        FileError: anything else; `where` begins its message.
    """
    text = value if isinstance(value, str) else repr(value)
    if not _NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        raise FileError(f"{where}: expected a number, found {value!r}")
    return float(text)


def temporary_of(path: Path) -> Path:
    """Where `path` is written until it is complete."""
    return path.with_name(f".{path.name}.part")


@contextmanager
def replacing(path: Path, begun: bool = False) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it when the block ends, removed when it raises.

    The next writer of `path` removes what a killed one has left, unless it goes on with what is `begun`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_of(path)
    if not begun:
        temporary.unlink(missing_ok=True)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_tensors(path: Path, tensors: Mapping, metadata: Mapping) -> None:
    """Write a safetensors file; the metadata are one JSON text, since the order of several would change by chance."""
    from safetensors.torch import save_file

    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        save_file(contiguous, temporary, {"json": json.dumps(metadata)})


_DTYPES = {"uint8": "U8", "int64": "I64"}  # as safetensors calls them


@contextmanager
def writing_tensors(
    path: Path, tensors: Mapping, metadata: Mapping, begun: bool = False
) -> Iterator[tuple[dict, Callable[[], None]]]:
    """The tensors of a safetensors file that is being written, mapped: for more than fits into memory.

    Args:
        tensors: (by name) int64 or uint8, the former first, so that all are aligned; those on the device `meta` have a
            shape, and the block has to fill them in.
        begun: go on with the file that a killed writer of the same tensors has left, whose values are kept.

    Yields:
        The tensors, and a function after which all that was written to them survives the machine.

    Raises:
        FileError: the disk has no room for the file; before the block.

    Source: the format, in the README of safetensors 0.4.
    """
    import numpy
    import torch

    header: dict = {"__metadata__": {"json": json.dumps(metadata)}}
    end = 0
    for name, tensor in tensors.items():
        begin, end = end, end + tensor.nbytes
        dtype = _DTYPES[str(tensor.dtype).removeprefix("torch.")]
        header[name] = {"dtype": dtype, "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with replacing(path, begun) as temporary:
        if not begun:
            with open(temporary, "wb") as file:
                file.write(len(text).to_bytes(8, "little") + text)
                free = shutil.disk_usage(temporary.parent).free  # a mapped file without room kills the job instead
                if free < end:
                    raise FileError(f"{path}: needs {end / 1e6:.1f} MB, the disk has {free / 1e6:.1f} MB free")
                file.truncate(file.tell() + end)
        raw = numpy.memmap(temporary, numpy.uint8, "r+", offset=8 + len(text))
        mapped = {}
        for name, tensor in tensors.items():
            part = torch.from_numpy(raw[slice(*header[name]["data_offsets"])])
            mapped[name] = part.view(tensor.dtype).view(tensor.shape)
            if not tensor.is_meta:
                mapped[name].copy_(tensor)
        yield mapped, raw.flush
        raw.flush()


def map_tensors(path: Path) -> tuple[dict, dict]:
    """Tensors (int64, uint8) and metadata of a safetensors file, mapped read-only: for more than fits into memory.

    Linux refuses mappings that could be written to, such as those of `read_tensors`, beyond memory and swap.

    Raises:
        FileError: the file is not complete.
    """
    import warnings

    import numpy
    import torch

    kinds = {name: dtype for dtype, name in _DTYPES.items()}
    try:
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
        raw = numpy.memmap(path, numpy.uint8, "r", offset=8 + length)
        metadata = json.loads(header.pop("__metadata__")["json"])
        mapped = {}
        for name, entry in header.items():
            part = raw[slice(*entry["data_offsets"])]
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # torch's, that nothing may be written
                tensor = torch.from_numpy(part)
            mapped[name] = tensor.view(getattr(torch, kinds[entry["dtype"]])).view(entry["shape"])
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise FileError(f"{path}: no complete file of labelled pictures; remove it ({error})") from error
    return mapped, metadata


def read_tensors(path: Path) -> tuple[dict, dict]:
    """Tensors and metadata of a safetensors file; the tensors are mapped from the file, not copied."""
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = json.loads((file.metadata() or {}).get("json", "{}"))
    return tensors, metadata


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write rows as CSV; the columns are the keys of all rows, in order of appearance."""
    import csv

    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_if_changed(path: str | Path, text: str) -> None:
    """Write a text file unless it already says so."""
    path = Path(path)
    if not path.exists() or path.read_text() != text:
        write_text(path, text)
