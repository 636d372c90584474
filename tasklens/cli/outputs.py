"""What commands print and write: tables, JSON, and files that are not overwritten by accident."""

import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tasklens.runtime.errors import InputError

Force = Annotated[bool, typer.Option("--force", help="Overwrite the output file.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


def new_file(path: Path, force: bool, *suffixes: str) -> Path:
    """Return the path of an output; raises InputError if it exists or has none of the suffixes."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    if path.is_dir() or (path.exists() and not force):
        raise InputError(f"{path}: already exists; --force overwrites it" if path.is_file() else f"{path}: is a folder")
    return path


def print_json(content: Any) -> None:
    """Print JSON; numbers that are not finite become null."""
    print(json.dumps(_finite(content), indent=2))


def say(text: str) -> None:
    """Print a message for the user on standard error; standard output is for results."""
    print(f"tasklens: {text}", file=sys.stderr)


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
