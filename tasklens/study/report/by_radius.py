"""The accuracy of one lens over the distance from the axis, as a small figure."""

import io
from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.figure import Figure

from tasklens.show import vector_files
from tasklens.study.report.measurements import FIELD

Row = Mapping[str, float]


def points(row: Row, radii: Sequence[float]) -> list[tuple[float, float]]:
    """Return (radius, accuracy [%]) from a row of a table by seed, from the axis to the corner.

    Args:
        radii: distances of the fields of the grading from the axis, in units of that of the corner.
    """
    values = [(radius, row[f"{FIELD}{k}"]) for k, radius in enumerate(radii) if f"{FIELD}{k}" in row]
    return sorted([*values, *([(1.0, row["corner_accuracy"])] if "corner_accuracy" in row else [])])


def svg(row: Row, radii: Sequence[float], seen: Sequence[float]) -> str:
    """Draw the accuracy; dotted lines are at `seen`, the radii of the fields that the design sees."""
    with matplotlib.rc_context({**vector_files.STYLE, "font.size": 8}):
        figure, text = Figure(figsize=(4.5, 2), layout="constrained"), io.StringIO()
        axes = figure.subplots()
        for radius in {round(radius, 4) for radius in seen}:
            axes.axvline(radius, color="grey", linewidth=0.7, linestyle=":")
        axes.plot(*zip(*points(row, radii), strict=True), "o-", color="#0072B2", markersize=3, linewidth=1.2)
        axes.set(xlabel="distance from the axis [of the corner]", ylabel="accuracy [%]", xlim=(0, 1.02))
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(text, format="svg", metadata=vector_files.METADATA["svg"])
    return text.getvalue()
