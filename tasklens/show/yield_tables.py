"""Losses of a lens in manufacture, for a terminal: yields, the worst offenders, and tolerances for a drawing."""

from collections.abc import Mapping
from typing import Any

import pandas

from tasklens.optics.tolerancing.monte_carlo import YIELD
from tasklens.optics.tolerancing.yields import KEPT_MTF

_GROWTH = (1.1, 1.25, 1.5, 2.0)  # largest ratios of the mean RMS spot to the design's with which a lens passes
_KEPT = (0.95, 0.9, 0.8, 0.6)  # smallest ratios of the mean MTF to the design's with which a lens passes
_SHOWN = 10  # errors with the largest displacement
_NOTE = """\
  Surfaces are numbered from 0; an element has the number of its first surface, about whose vertex it tilts. Form 3 6:
  spherical aberration of sixth order on surface 3, peak to valley over the clear aperture. Ray shift: RMS of the half
  of the rays next to the chief ray, at the full tolerance, after focusing."""
_MTF = "mtf_quarter_nyquist"
_QUALITIES = {
    "rms_spot_um": "RMS spot, mean of the fields [um]",
    "rms_spot_worst_um": "RMS spot, worst field [um]",
    _MTF: "MTF",
}


def summary(tolerances: Mapping[str, Any], grade: str, frequency: float) -> dict[str, Any]:
    """Return the figures of the design and built lenses, yields [%], errors by displacement, allotted tolerances.

    Args:
        tolerances: measurements of the design and of built lenses, from `yields.tolerances`.
        grade: name of the grade.
        frequency: frequency of the MTF [cycles/mm].
    """
    design, built = tolerances["design"], pandas.DataFrame(tolerances["built"])
    spots, mtf = built["rms_spot_um"], built[_MTF]
    return {
        "grade": grade,
        "lenses": len(built),
        "frequency_per_mm": frequency,
        "peak_um": tolerances["peak_um"],
        "design": design,
        "median": built.median().to_dict(),
        "at_95_percent_yield": built.quantile(0.95).to_dict() | {_MTF: float(mtf.quantile(0.05))},
        "yield_by_rms_percent": {factor: _share(spots <= factor * design["rms_spot_um"]) for factor in _GROWTH},
        "yield_by_mtf_percent": {share: _share(mtf >= share * design[_MTF]) for share in _KEPT},
        "errors": sorted(tolerances["errors"], key=lambda error: error["moved_um"], reverse=True),
    }


def text(name: str, data: Mapping[str, Any]) -> str:
    """Format a summary as lines for a terminal."""
    lines = [
        f"{name}: {data['lenses']} lenses built to {data['grade'].replace('_', ' ')}, each focused like the design, "
        f"{abs(data['peak_um']):.0f} um from the peak of its MTF; MTF at {data['frequency_per_mm']:.0f} cycles/mm",
        f"  {'':<36}{'design':>9}{'median':>9}{'95 % yield':>15}",
    ]
    for key, meaning in _QUALITIES.items():
        values = (data["design"][key], data["median"][key], data["at_95_percent_yield"][key])
        lines.append(f"  {meaning:<36}{values[0]:>9.2f}{values[1]:>9.2f}{values[2]:>15.2f}")
    by_rms = _shares("up to {:g} times", data["yield_by_rms_percent"])
    by_mtf = _shares("keep {:.0f} %", {100 * kept: share for kept, share in data["yield_by_mtf_percent"].items()})
    lines += [
        f"  yield by RMS spot relative to the design: {by_rms}",
        f"  yield by MTF relative to the design: {by_mtf}",
        "",
    ]
    frame = pandas.DataFrame(data["errors"][:_SHOWN], columns=["error", "tolerance", "unit", "moved_um", "allotted"])
    frame["tolerance"] = frame["tolerance"].map("{:.4g}".format)
    frame["moved_um"] = frame["moved_um"].map("{:.2f}".format)
    headings = {"moved_um": "ray shift [um]"}
    if frame["allotted"].isna().all():
        frame = frame.drop(columns="allotted")
        lines.append(
            f"  no tolerances that were tried keep {100 * KEPT_MTF:.0f} % of the MTF in {100 * YIELD:.0f} % of lenses"
        )
    else:
        frame["allotted"] = frame["allotted"].map("{:.2g}".format)
        headings["allotted"] = "for the drawing"
        lines.append(
            f"  tolerances for the drawing: the cheapest with which {100 * YIELD:.0f} % of lenses keep "
            f"{100 * KEPT_MTF:.0f} % of the MTF; the {len(frame)} that matter most (--json: all)"
        )
    table = frame.rename(columns=headings).to_string(index=False)
    return "\n".join([*lines, *(f"  {line}" for line in table.splitlines()), _NOTE])


def _shares(condition: str, yields: Mapping[float, float]) -> str:
    return ", ".join(f"{share:.0f} % {condition.format(bound)}" for bound, share in yields.items())


def _share(good: pandas.Series) -> float:
    return 100 * float(good.mean())
