"""Functions written by users, named `package.module:function`; no torch here."""

import hashlib
import os
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tasklens.runtime.errors import InputError


def is_users(name: str) -> bool:
    """Return whether a name refers to a user's function."""
    return ":" in name


def load(name: str) -> Callable[..., Any]:
    """Import a function from an installed package or from the current folder; raises InputError."""
    module, _, function = name.partition(":")
    if "/" in module or module.endswith(".py"):
        raise InputError(f"{name}: expected a module, not a file: {Path(module).stem}:{function}, in the file's folder")
    _search_here()
    try:
        return getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"{name}: expected package.module:function, installed, in this folder or on PYTHONPATH: {error}"
        ) from None


def digest(name: str) -> str | None:
    """Return the digest of the file of a user's function, a change of which reruns its jobs; None for other names."""
    if not is_users(name):
        return None
    _search_here()
    try:
        spec = find_spec(name.partition(":")[0])
    except (ImportError, ValueError):
        return None
    file = None if spec is None or spec.origin is None else Path(spec.origin)
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16] if file is not None and file.is_file() else None


def _search_here() -> None:
    """Make modules of the current folder importable, as `python -m` does."""
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
