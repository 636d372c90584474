"""Page on the tolerances of a lens: losses of built lenses, the errors that cause them, tolerances to quote."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy
import pandas

from tasklens.show import headings
from tasklens.show.publish import right_aligned

POINTS = (1.0, 3.0)  # largest losses of accuracy with which a built lens passes
_SHOWN = 10  # errors with the largest displacement


def distribution(rows: Sequence[Mapping[Any, Any]]) -> dict[str, float]:
    """Summarise built lenses: accuracies [%], loss [points], yields [%], spots [um], MTF, and number of failures.

    Args:
        rows: the design, then the built lenses, as `production.built_lenses` returns them.
    """
    design, built = rows[0], rows[1:]
    accuracy = numpy.array([float(row["accuracy"]) for row in built])
    nominal = float(design["accuracy"])
    return {
        "accuracy_design": nominal,
        "accuracy": float(accuracy.mean()),
        "accuracy_5th": float(numpy.quantile(accuracy, 0.05)),
        "lost": nominal - float(accuracy.mean()),
        **{f"yield_{points:g}": 100 * float((accuracy >= nominal - points - 1e-9).mean()) for points in POINTS},
        "rms_spot_um_design": float(design["rms_spot_um"]),
        "rms_spot_um": float(numpy.median([float(row["rms_spot_um"]) for row in built])),
        "mtf_quarter_nyquist_design": float(design["mtf_quarter_nyquist"]),
        "mtf_quarter_nyquist": float(numpy.median([float(row["mtf_quarter_nyquist"]) for row in built])),
        "failed_lenses": sum(int(row["failed"]) for row in built),
        "built": len(built),
    }


def markdown(
    title: str, grade: str, rows: Sequence[Mapping[str, Any]], errors: Sequence[Mapping[str, Any]], images: int
) -> str:
    """Return the page.

    Args:
        rows: the design and the built lenses.
        errors: a row per error, as written by the stage `production`.
        images: number of images on which each lens is measured.
    """
    stats = distribution(rows)
    failed = f" {stats['failed_lenses']} of them let no light through to some field." if stats["failed_lenses"] else ""
    summary = (
        f"{stats['built']} lenses were built in simulation to {grade.replace('_', ' ')}, focused by their MTF, and "
        f"measured by the classifier of the design on {images} images over the sensor. The design has "
        f"{stats['accuracy_design']:.1f} %, they have {stats['accuracy']:.1f} % (95 of 100 more than "
        f"{stats['accuracy_5th']:.1f} %). {stats['yield_1']:.0f} % lose at most one point, {stats['yield_3']:.0f} % at "
        f"most three.{failed} The RMS spot is {stats['rms_spot_um_design']:.1f} um in the design and "
        f"{stats['rms_spot_um']:.1f} um in the median, the MTF at a quarter of Nyquist's frequency "
        f"{stats['mtf_quarter_nyquist_design']:.2f} and {stats['mtf_quarter_nyquist']:.2f}."
    )
    frame = pandas.DataFrame(errors)
    worst = frame.sort_values("moved_um", ascending=False)[:_SHOWN][
        ["error", "unit", "tolerance", "moved_um", "traced_um", "accuracy_change"]
    ]
    allotted = frame[["error", "unit", "tolerance", "allotted"]]
    drawing = (
        "No tolerances that were tried, the tightest about a 32nd of the grade's, keep 95 % of lenses within one point."
        if frame["allotted"].isna().all()
        else "With the tolerances in the last column, loose where they cost little, at least 95 % of the lenses "
        "that were built to choose them lose at most one point, on minival images.\n\n"
        + right_aligned(headings.texts(allotted))
    )
    parts = [
        f"# Tolerances of {title}",
        summary,
        "## Worst offenders",
        "RMS displacement of the rays of the core by an error as large as its tolerance, refocused [um]: by "
        "derivative, and traced with this error alone; and the change of the accuracy [points], mean of both signs.",
        right_aligned(headings.texts(worst)),
        "## Tolerances for a drawing",
        drawing,
    ]
    return "\n\n".join(parts) + "\n"
