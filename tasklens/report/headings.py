"""Readable columns of tables: headings with units, numbers with their spread, and the best values."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import pandas

STD, PAPER = "_std", "_paper"
_GROUPS = ("elements", "classifier")  # within which the best value is marked


class Heading(NamedTuple):
    """Heading of a column: words, unit, decimals, which values are the best, and the factor to the unit."""

    words: str
    unit: str = ""
    digits: str = ".2f"
    best: Literal["max", "min", ""] = ""
    factor: float = 1.0


HEADINGS = {
    "accuracy": Heading("accuracy", "%", ".1f", "max"),
    "zero_shot_accuracy": Heading("zero-shot accuracy", "%", ".1f", "max"),
    "accuracy_median": Heading("median", "%", ".1f", "max"),
    "accuracy_best": Heading("best seed by minival", "%", ".1f", "max"),
    "reference_accuracy": Heading("sharp images", "%", ".1f"),
    "frozen_loss": Heading("loss before fine-tuning", "", ".3f", "min"),
    "gap": Heading("optimality gap", "", "+.3f"),
    "psnr_db": Heading("PSNR", "dB", ".1f", "max"),
    "worst_psnr_db": Heading("worst PSNR", "dB", ".1f", "max"),
    "rms_spot_um": Heading("RMS spot", "um", ".1f", "min"),
    "core_radius_um": Heading("core radius", "um", ".1f", "min"),
    "radius_80_um": Heading("80 % radius", "um", ".1f", "min"),
    "energy_in_window": Heading("light in window", "", ".3f", "max"),
    "tail_energy": Heading("light in tail", "", ".3f"),
    "outside_window": Heading("light outside window", "", ".3f"),
    "rms_um": Heading("RMS about chief ray", "um", ".1f"),
    "rms_over_core": Heading("RMS over core", "", ".1f"),
    "worst_margin": Heading("worst margin", "", "+.3f"),
    "failed": Heading("failed", "%", ".0f", factor=100.0),
    "parameters_m": Heading("parameters", "M", ".1f"),
    "lenses_tried": Heading("lenses tried", "", ".0f"),
    "lenses_tried_in_all": Heading("lenses tried in all", "", ".0f"),
    "core_minutes": Heading("time", "min", ".1f"),
    "core_minutes_in_all": Heading("time in all", "min", ".1f"),
    "difference": Heading("difference", "points", "+.1f"),
    "low": Heading("from", "points", "+.1f"),
    "high": Heading("to", "points", "+.1f"),
    "p_holm": Heading("p (Holm)", "", ".3f"),
    "jobs": Heading("jobs", "", ".0f"),
    "total_min": Heading("in all", "min", ".1f"),
    "mean_min": Heading("mean", "min", ".2f"),
    "longest_min": Heading("longest", "min", ".1f"),
    "memory_mb": Heading("most memory", "MB", ".0f"),
    "seeds": Heading("seeds", "", ".0f"),
    "plastics": Heading("plastics", "", ".0f"),
    "field_of_view_deg": Heading("field of view", "deg", ".1f"),
    "f_number": Heading("F-number", "", ".1f"),
    "rms_task_um": Heading("RMS, task", "um", ".1f"),
    "rms_imaging_um": Heading("RMS, imaging", "um", ".1f"),
    "tried_task": Heading("lenses tried, task", "", ".0f"),
    "tried_imaging": Heading("lenses tried, imaging", "", ".0f"),
}


def heading(name: str) -> Heading:
    """Return the heading of a column, the same for the paper's values; the name in words if it has no heading."""
    base = name.removesuffix(PAPER)
    return HEADINGS.get(base, Heading(base.replace("_", " ")))


def columns(table: pandas.DataFrame) -> list[str]:
    """Return the columns to show: without standard deviations of shown means, and with the paper's columns last."""
    names = [str(name) for name in table if not str(name).endswith(STD) or str(name).removesuffix(STD) not in table]
    return sorted(names, key=lambda name: name.endswith(PAPER))


def number(name: str, row: Mapping[Any, Any]) -> tuple[str, str]:
    """Return a number of a row and its standard deviation over seeds as texts; "" without a standard deviation."""
    column = heading(name)
    spread = row.get(f"{name}{STD}", math.nan)
    text = "" if pandas.isna(spread) else format(column.factor * spread, column.digits.removeprefix("+"))
    return format(column.factor * row[name], column.digits), text


def best(table: pandas.DataFrame, name: str) -> Sequence[bool]:
    """Return by row whether its rounded value is the best of its elements and classifier; a single row has no best."""
    column = heading(name)
    if not column.best or name.endswith(PAPER) or not pandas.api.types.is_numeric_dtype(table[name]):
        return [False] * len(table)
    keys = [table[key].fillna("") for key in _GROUPS if key in table]
    values = table[name].round(int(column.digits.strip("+.f")))
    groups = values.groupby(keys) if keys else values.groupby([0] * len(table))
    return ((values == groups.transform(column.best)) & (groups.transform("count") > 1)).tolist()
