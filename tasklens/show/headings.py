"""Columns of tables for readers: headings with units and meanings, number formats, and the best values.

Every Markdown, LaTeX and HTML table of a study is formatted here, so that a number looks the same everywhere.
The headings are in `headings.csv`, those of figures by field in `BY_FIELD`.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas

STD, PAPER = "_std", "_paper"
GAP = "–"
_NO_LENS = "no lens"  # row of sharp images
_LEAST_P = 0.001  # smaller p-values are shown as such
_GROUPS = ("elements", "classifier", "task", "score")  # within which the best value is marked


class Heading(NamedTuple):
    """Heading of a column: words, unit, number format, best values, factor to the unit, and meaning in a sentence."""

    words: str
    unit: str = ""
    digits: str = ""  # "" for texts; else two decimals, or none for integers
    best: Literal["max", "min", ""] = ""
    factor: float = 1.0
    meaning: str = ""

    @property
    def text(self) -> str:
        """The words with the unit in brackets."""
        return f"{self.words} [{self.unit}]" if self.unit else self.words


def _read(path: Path) -> dict[str, Heading]:
    """Read headings by column; an empty factor is 1."""
    rows: list[dict[str, Any]] = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    return {row.pop("name"): Heading(**row | {"factor": float(row["factor"] or 1)}) for row in rows}


HEADINGS = _read(Path(__file__).with_name("headings.csv"))
BY_FIELD = {  # figures of a lens at its fields; those with a meaning are shown at a glance
    "angle_deg": Heading("angle", "deg", ".1f", meaning="field [degrees]"),
    "valid_fraction": Heading("valid", "", ".3f"),
    "rms_centroid_um": Heading("RMS, centroid", "um", ".2f", meaning="RMS spot radius, about centroid [um]"),
    "rms_chief_ray_um": Heading("RMS, chief ray", "um", ".2f"),
    "rms_wavefront_waves": Heading("RMS wavefront", "waves", ".3f"),
    "core_radius_um": Heading("EE50", "um", ".2f", meaning="radius of 50 % of the light [um]"),
    "radius_80_um": Heading("EE80", "um", ".2f", meaning="radius of 80 % of the light [um]"),
    "mtf_tangential_quarter_nyquist": Heading("MTF T 1/4", "", ".2f"),
    "mtf_sagittal_quarter_nyquist": Heading("MTF S 1/4", "", ".2f"),
    "mtf_tangential_half_nyquist": Heading("MTF T 1/2", "", ".2f", meaning="geometric MTF at half Nyquist, T"),
    "mtf_sagittal_half_nyquist": Heading("MTF S 1/2", "", ".2f", meaning="geometric MTF at half Nyquist, S"),
    "energy_in_window": Heading("light in window", "", ".3f", meaning="light in the PSF window"),
    "distortion_percent": Heading("distortion", "%", ".2f", meaning="distortion [%]"),
    "focus_tangential_um": Heading("focus T", "um", ".1f"),
    "focus_sagittal_um": Heading("focus S", "um", ".1f"),
    "relative_illumination": Heading("rel. illum.", "", ".3f", meaning="relative illumination"),
}


def heading(name: str) -> Heading:
    """Return the heading of a column, the same for the paper's values; the name in words if it has no heading."""
    base = name.removesuffix(PAPER)
    return HEADINGS.get(base, Heading(base if "=" in base else base.replace("_", " ")))  # points of a sweep have a =


def columns(table: pandas.DataFrame) -> list[str]:
    """Return the columns to show: without standard deviations of shown means, and with the paper's columns last."""
    names = [str(name) for name in table if not str(name).endswith(STD) or str(name).removesuffix(STD) not in table]
    return sorted(names, key=lambda name: name.endswith(PAPER))


def number(name: str, row: Mapping[Any, Any]) -> tuple[str, str]:
    """Return a number of a row and its standard deviation over seeds as texts; "" without a standard deviation."""
    column = heading(name)
    digits = column.digits or (".0f" if isinstance(row[name], int) else ".2f")
    spread = row.get(f"{name}{STD}", math.nan)
    text = "" if pandas.isna(spread) else format(column.factor * spread, digits.removeprefix("+"))
    return format(column.factor * row[name], digits), text


def is_number(column: pandas.Series) -> bool:
    """Return whether a column holds numbers, not texts or truth values."""
    return pandas.api.types.is_numeric_dtype(column) and column.dtype != bool


def cell(name: str, row: Mapping[Any, Any], numeric: bool) -> str:
    """Format a cell: a text, a dash for a gap, or a number with its standard deviation."""
    value = row[name]
    if pandas.isna(value) or value == "":
        return GAP
    if not numeric:
        return _NO_LENS if (name, value) == ("design", "reference") else str(value)
    if name == "p_holm" and value < _LEAST_P:
        return f"<{_LEAST_P:g}"
    return " ± ".join(filter(None, number(name, row)))


def texts(table: pandas.DataFrame) -> pandas.DataFrame:
    """Format a table: headings with units, numbers with their spread, gaps as dashes, the paper's columns last."""
    names = columns(table)
    numeric = {name: is_number(table[name]) for name in names}
    rows = [[cell(name, row, numeric[name]) for name in names] for row in table.to_dict("records")]
    return pandas.DataFrame(rows, columns=[f"{heading(name).text}{', paper' * name.endswith(PAPER)}" for name in names])


def best(table: pandas.DataFrame, name: str) -> Sequence[bool]:
    """Return by row whether its rounded value is the best of its elements, classifier and score, if it has rivals."""
    column = heading(name)
    if not column.best or name.endswith(PAPER) or not pandas.api.types.is_numeric_dtype(table[name]):
        return [False] * len(table)
    if "elements" not in table and "lens" in table:
        table = table.assign(elements=table["lens"].fillna("").str.partition("-")[0])
    keys = [table[key].fillna("") for key in _GROUPS if key in table]
    values = table[name].round(int(column.digits.strip("+.f")))
    groups = values.groupby(keys) if keys else values.groupby([0] * len(table))
    return ((values == groups.transform(column.best)) & (groups.transform("count") > 1)).tolist()
