"""Columns of tables for readers: headings with units and meanings, number formats, and the best values.

Every Markdown, LaTeX and HTML table of a study is formatted here, so that a number looks the same everywhere.
"""

import math
from collections.abc import Mapping, Sequence
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


HEADINGS = {
    "accuracy": Heading("accuracy", "%", ".1f", "max", meaning="Correct answers on test images, mean over the sensor"),
    "corner_accuracy": Heading("corner", "%", ".1f", "max", meaning="Accuracy in the corner of the sensor"),
    "accuracy_at_design_fields": Heading(
        "at its fields", "%", ".1f", meaning="Accuracy at the fields for which the lens was designed"
    ),
    "accuracy_at_nine": Heading("at nine fields", "%", ".1f", meaning="Accuracy at the nine fields of the paper"),
    "zero_shot_accuracy": Heading(
        "zero-shot accuracy", "%", ".1f", "max", meaning="Among all outputs of the network, without fine-tuning"
    ),
    "accuracy_median": Heading("median", "%", ".1f", "max", meaning="Median accuracy over seeds"),
    "accuracy_best_minival": Heading(
        "best seed by minival", "%", ".1f", "max", meaning="Accuracy of the seed with the best accuracy on minival"
    ),
    "reference_accuracy": Heading("sharp images", "%", ".1f", meaning="Accuracy on images without a lens"),
    "frozen_loss": Heading(
        "loss before fine-tuning",
        *("", ".3f", "min"),
        meaning="Cross-entropy of the frozen network on minival images through the lens",
    ),
    "gap": Heading(
        "optimality gap",
        *("", "+.3f"),
        meaning="Loss before fine-tuning minus that of the best other lens with the same elements; negative is better",
    ),
    "psnr_db": Heading("PSNR", "dB", ".1f", "max", meaning="Peak signal-to-noise ratio of captures, mean over fields"),
    "worst_psnr_db": Heading(
        "worst PSNR", "dB", ".1f", "max", meaning="Mean PSNR of the worst hundredth of images, mean over fields"
    ),
    "focus": Heading("focus", meaning="What sets the image plane: the file, the network, the MTF, or the spot"),
    "image_plane_shift_um": Heading(
        "focus shift", "um", "+.1f", meaning="Of the image plane, from its place in the file"
    ),
    "rms_spot_um": Heading("RMS spot", "um", ".1f", "min", meaning="RMS distance of rays from their centroid"),
    "core_radius_um": Heading(
        "core radius", "um", ".1f", "min", meaning="Radius of the circle about the chief ray with half of the light"
    ),
    "radius_80_um": Heading(
        "80 % radius", "um", ".1f", "min", meaning="Radius of the circle about the chief ray with 80 % of the light"
    ),
    "energy_in_window": Heading("light in window", "", ".3f", "max", meaning="Share of light inside the PSF window"),
    "tail_energy": Heading("light in tail", "", ".3f", meaning="Share of light outside three core radii"),
    "energy_outside_window": Heading(
        "light outside window", "", ".3f", meaning="Share of light outside the PSF window"
    ),
    "rms_chief_ray_um": Heading("RMS about chief ray", "um", ".1f", meaning="RMS distance of rays from the chief ray"),
    "rms_over_core": Heading("RMS / core", "", ".1f", meaning="1 for a uniform disc, 1.2 for a Gaussian spot"),
    "worst_margin": Heading(
        "worst margin",
        *("", "+.3f"),
        meaning="Distance to the nearest limit, in its own unit (mm, degrees, or none); negative: violated",
    ),
    "failed": Heading(
        "failed",
        *("%", ".0f"),
        factor=100.0,
        meaning="Share of seeds with more than half of the light outside the window, or half of the accuracy above "
        "chance lost",
    ),
    "parameters_m": Heading("parameters", "M", ".1f"),
    "evaluations": Heading("evaluations", "", ".0f"),
    "evaluations_in_all": Heading("evaluations in all", "", ".0f"),
    "wall_minutes": Heading("time", "min", ".1f"),
    "wall_minutes_in_all": Heading("time in all", "min", ".1f"),
    "difference": Heading(
        "difference",
        "points",
        "+.1f",
        meaning="Accuracy of the lens minus that of its baseline, or points lost in manufacture minus those of the "
        "baseline; for a failure, the distance to its rule",
    ),
    "low": Heading("from", "points", "+.1f", meaning="Lower end of the 95 % interval"),
    "high": Heading("to", "points", "+.1f", meaning="Upper end of the 95 % interval"),
    "difference_at_nine": Heading(
        "at nine fields", "points", "+.1f", meaning="The same difference at the nine fields of the paper"
    ),
    "low_at_nine": Heading("at nine, from", "points", "+.1f"),
    "high_at_nine": Heading("at nine, to", "points", "+.1f"),
    "p_holm": Heading("p (Holm)", "", ".3f", meaning="p-value, corrected for all rows of the same claim and table"),
    "median": Heading("median", "points", "+.1f", meaning="Median of the differences of the seeds"),
    "above": Heading("seeds above", "", ".0f", meaning="Seeds with a difference above zero, or minus the margin"),
    "jobs": Heading("jobs", "", ".0f"),
    "seeds": Heading("seeds", "", ".0f"),
    "total_min": Heading("in all", "min", ".1f"),
    "mean_min": Heading("mean", "min", ".2f"),
    "longest_min": Heading("longest", "min", ".1f"),
    "memory_mb": Heading("peak memory", "MB", ".0f"),
    "field_of_view_deg": Heading("field of view", "deg", ".1f"),
    "f_number": Heading("F-number", "", ".2f"),
    "frozen": Heading("frozen", "%", ".1f", "max", meaning="Score of the network that was trained on sharp images"),
    "tuned": Heading("tuned", "%", ".1f", "max", meaning="Score after fine-tuning on the captures of the lens"),
    "worst_field": Heading("worst field", "%", ".1f", "max", meaning="Score after fine-tuning at the worst field"),
    "accuracy_design": Heading("accuracy of the design", "%", ".1f"),
    "accuracy_5th": Heading("5th percentile", "%", ".1f", meaning="Accuracy that 95 of 100 built lenses exceed"),
    "lost": Heading("lost", "points", ".1f", meaning="Accuracy of the design minus the mean of built lenses"),
    "yield_1": Heading("yield, 1 point", "%", ".1f", meaning="Built lenses that lose at most one point"),
    "yield_3": Heading("yield, 3 points", "%", ".1f", meaning="Built lenses that lose at most three points"),
    "rms_spot_um_design": Heading("RMS spot of the design", "um", ".1f"),
    "mtf_quarter_nyquist_design": Heading("MTF of the design", "", ".2f"),
    "mtf_quarter_nyquist": Heading("MTF", "", ".2f", meaning="MTF at a quarter of the Nyquist frequency"),
    "mtf_mean": Heading("mean MTF", "", ".2f", meaning="Mean MTF up to half the Nyquist frequency"),
    "failed_lenses": Heading("failed lenses", meaning="Built lenses that let no light through to some field"),
    "built": Heading("built", "", ".0f"),
    "tolerance": Heading("tolerance", "", ".4g"),
    "allotted": Heading("allotted tolerance", "", ".2g"),
    "moved_um": Heading("rays move", "um", ".2f", meaning="RMS displacement of the core's rays, by derivative"),
    "traced_um": Heading("rays move, traced", "um", ".2f"),
    "accuracy_change": Heading("change of accuracy", "points", "+.2f"),
    "accuracy_low": Heading("from", "%", ".1f", meaning="Lower end of the 95 % interval of the accuracy"),
    "accuracy_high": Heading("to", "%", ".1f", meaning="Upper end of the 95 % interval of the accuracy"),
    "behind": Heading("behind", "points", ".1f", meaning="Accuracy of the best lens minus that of this one"),
    "behind_low": Heading("behind, from", "points", ".1f"),
    "behind_high": Heading("behind, to", "points", ".1f"),
    "accuracy_axis": Heading("axis", "%", ".1f"),
    "accuracy_corner": Heading("corner", "%", ".1f"),
    "built_lose": Heading("built lose", "points", ".1f"),
    "built_lose_95": Heading("95 of 100 lose less", "points", ".1f"),
}
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
