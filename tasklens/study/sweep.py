"""Sweeps: a study is run at every point of a grid of values, each point in a folder of its own."""

import math
import re
from itertools import product
from typing import Annotated, Any

from pydantic import AfterValidator

_MOST = 1000  # points, each with a folder of its own
_FIXED = ("format", "name", "sweep")  # the same at all points
_VALUE = re.compile(r"[\w./+-]+")  # as part of a folder's name, in which slashes are hyphens


def _check(sweep: dict[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    for key, values in sweep.items():
        if key.split(".")[0] in _FIXED:
            raise ValueError(f"sweep.{key}: cannot differ between points; expected another key, such as spec.f_number")
        if key.startswith("designs.") and key.endswith(".method"):
            raise ValueError(f"sweep.{key}: each method has other keys; expected several designs in `designs`")
        for value in values:
            if not isinstance(value, bool | int | float | str) or not _VALUE.fullmatch(str(value)):
                raise ValueError(f"sweep.{key}: expected numbers, names, paths, true or false, found {value!r}")
        if not values or min(len(set(values)), len(set(map(_word, values)))) < len(values):
            raise ValueError(f"sweep.{key} = {list(values)}: expected at least one value, and no duplicates")
    if (count := math.prod(map(len, sweep.values()))) > _MOST:
        raise ValueError(f"sweep: {count} points; expected at most {_MOST}")
    return sweep


Sweep = Annotated[dict[str, tuple[Any, ...]], AfterValidator(_check)]  # values by dotted key


def points(sweep: Sweep) -> dict[str, dict[str, Any]]:
    """Return the values of the keys at every point, by the name of the point; the last key varies fastest.

    Names are `{key}={value}`, joined by two hyphens, since commas separate the wildcards of a job on a cluster.
    """
    grid = (dict(zip(sweep, values, strict=True)) for values in product(*sweep.values()))
    return {"--".join(f"{key}={_word(value)}" for key, value in point.items()): point for point in grid}


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value).replace("/", "-")
