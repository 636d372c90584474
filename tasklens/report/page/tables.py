"""Tables of the page: columns with headings and units, cells with numbers to sort by, and the best values marked."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import pandas

from tasklens.report.publish import GAP

STD, PAPER = "_std", "_paper"
_GROUPS = ("elements", "classifier")  # within which the best value is marked


class Heading(NamedTuple):
    """Heading of a column: words, unit, decimals, and which values are the best."""

    words: str
    unit: str = ""
    digits: str = ".2f"
    best: Literal["max", "min", ""] = ""


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
    "failed": Heading("failed", "%", ".0f"),
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
    "field_of_view_deg": Heading("field of view", "deg", ".1f"),
    "f_number": Heading("F-number", "", ".1f"),
    "rms_task_um": Heading("RMS, task", "um", ".1f"),
    "rms_imaging_um": Heading("RMS, imaging", "um", ".1f"),
}


@dataclass(frozen=True)
class Cell:
    """A cell: its text, the number or text to sort by, and whether it is the best of its group, or a violation."""

    text: str
    sort: float | str
    best: bool = False
    wrong: bool = False


@dataclass(frozen=True)
class Column:
    """A column: heading with its unit, whether it holds numbers, and whether it is the paper's."""

    words: str
    unit: str
    number: bool
    paper: bool


@dataclass(frozen=True)
class Table:
    """A table of the page."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    note: str = ""

    @property
    def paper(self) -> int:
        """Number of columns of the paper's values, which are the last."""
        return sum(column.paper for column in self.columns)

    @property
    def marked(self) -> bool:
        """Whether a best value is marked."""
        return any(cell.best for row in self.rows for cell in row)


def build(key: str, caption: str, frame: pandas.DataFrame, note: str = "") -> Table:
    """Build a table from a CSV file's contents; standard deviations join their means, the paper's columns come last."""
    names = [str(name) for name in frame if not str(name).endswith(STD) or str(name).removesuffix(STD) not in frame]
    names.sort(key=lambda name: name.endswith(PAPER))
    best = {name: _best(frame, name) for name in names}
    columns, numbers = [], {name: pandas.api.types.is_numeric_dtype(frame[name]) for name in names}
    for name in names:
        heading = _heading(name)
        columns.append(Column(heading.words, heading.unit, numbers[name], name.endswith(PAPER)))
    rows = [
        [_cell(name, row, numbers[name], bool(best[name][k])) for name in names]
        for k, row in enumerate(frame.to_dict("records"))
    ]
    return Table(key, caption, columns, rows, note)


def _heading(name: str) -> Heading:
    base = name.removesuffix(PAPER)
    return HEADINGS.get(base, Heading(base.replace("_", " ")))


def _cell(name: str, row: Mapping[Any, Any], number: bool, best: bool) -> Cell:
    value = row[name]
    if pandas.isna(value) or value == "":
        return Cell(GAP, "" if not number else -math.inf)
    if not number:
        return Cell(str(value), str(value))
    heading = _heading(name)
    scale = 100 if name.removesuffix(PAPER) == "failed" else 1
    text = format(scale * value, heading.digits)
    spread = row.get(f"{name}{STD}", math.nan)
    if not pandas.isna(spread):
        text += f" ± {format(spread, heading.digits.removeprefix('+'))}"
    return Cell(text, float(value), best, wrong=name == "worst_margin" and value < 0)


def _best(frame: pandas.DataFrame, name: str) -> Sequence[bool]:
    """Return by row whether its value is the best of its elements and classifier; none where a group has one row."""
    which = _heading(name).best
    if not which or name.endswith(PAPER) or not pandas.api.types.is_numeric_dtype(frame[name]):
        return [False] * len(frame)
    keys = [frame[key].fillna("") for key in _GROUPS if key in frame]
    shown = frame[name].round(int(_heading(name).digits.strip("+.f")))
    groups = shown.groupby(keys) if keys else shown.groupby([0] * len(frame))
    return ((shown == groups.transform(which)) & (groups.transform("count") > 1)).tolist()
