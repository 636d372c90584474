"""Mappings of settings: one laid over another, and checked for values that a file can hold; no torch here."""

import math
from collections.abc import Mapping
from datetime import date
from typing import Any

from tasklens.runtime.errors import InputError


def merged_settings(below: Mapping[str, Any], above: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return one mapping laid over another as Snakemake does it: mappings key by key, all else replaced.

    A mapping whose keys are the numbers of entries of a list below, such as {"0": {"steps": 200}}, changes these.

    Args:
        where: prefix of the keys in messages.

    Raises:
        InputError: the list has no entry of this number.
    """
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        if isinstance(under, list | tuple) and isinstance(value, Mapping) and _numbers(value):
            if missing := [number for number in value if int(number) >= len(under)]:
                raise InputError(f"{where}{key}.{missing[0]}: there is no such entry; expected 0 to {len(under) - 1}")
            entries = merged_settings(
                {str(k): entry for k, entry in enumerate(under)},
                {str(k): v for k, v in value.items()},
                f"{where}{key}.",
            )
            merged[key] = list(entries.values())
        elif isinstance(under, Mapping) and isinstance(value, Mapping):
            merged[key] = merged_settings(under, value, f"{where}{key}.")
        else:
            merged[key] = value
    return merged


def _numbers(keys: Mapping[str, Any]) -> bool:
    return bool(keys) and all(str(key).isdecimal() for key in keys)


def check_plain(value: Any, where: str) -> None:
    """Reject YAML values that a resolved study cannot hold; raises InputError with the key."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            name = f"{where}.{key}" if where else str(key)
            if not isinstance(key, str):
                raise InputError(f"{name}: expected a key that is text, found {key!r}; write it in quotes")
            check_plain(inner, name)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            check_plain(inner, f"{where}.{index}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{where} = {value}: expected a finite number")
    elif isinstance(value, date | bytes | set):
        raise InputError(f"{where} = {value!s}: expected a number, text, true, false or null; write text in quotes")
