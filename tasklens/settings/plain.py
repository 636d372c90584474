"""Check that values are plain: those that a study file can hold; no torch here."""

import math
from collections.abc import Mapping
from datetime import date
from typing import Any


def check_plain(value: Any, where: str) -> None:
    """Reject YAML values that a resolved study cannot hold; raises ValueError with the key."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            name = f"{where}.{key}" if where else str(key)
            if not isinstance(key, str):
                raise ValueError(f"{name}: expected a key that is text, found {key!r}; write it in quotes")
            check_plain(inner, name)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            check_plain(inner, f"{where}.{index}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{where} = {value}: expected a finite number")
    elif isinstance(value, date | bytes | set):
        raise ValueError(f"{where} = {value!s}: expected a number, text, true, false or null; write text in quotes")
