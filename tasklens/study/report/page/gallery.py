"""Entries of the gallery: drawings, numbers, limits and files of each lens."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import pandas
from matplotlib.figure import Figure

from tasklens.runtime.files import read_yaml
from tasklens.show import pictures, vector_files
from tasklens.show.glance import fields_by_angle
from tasklens.study.report.measurements import FIELD, lens_values
from tasklens.study.report_jobs import ReportJob

_HEADING = "## Manufacturability\n\n"
_PICTURES = {
    "section": "Cross-section of {name} with rays to axis, middle and corner of the sensor.",
    "spots": "Spot diagrams of {name}: {spots}.",
    "psfs": "Point spread functions of {name} from axis to corner; above their square root, below four decades.",
    "curves": "MTF and encircled energy of {name}: {mtf}.",
}
_ACCURACIES = {
    "accuracy": "accuracy",
    "corner_accuracy": "in the corner",
    "accuracy_at_design_fields": "at its fields",
    "accuracy_at_nine": "at nine fields",
}


@dataclass(frozen=True)
class LensFiles:
    """Files of each lens, as the rule names them: prescriptions, pages, downloads and drawings."""

    lenses: Sequence[Path]
    pages: Sequence[Path]
    zemax: Sequence[Path]
    catalogues: Sequence[Path]
    sections: Sequence[Path]
    spots: Sequence[Path]
    psfs: Sequence[Path]
    curves: Sequence[Path]


def entries(settings: ReportJob, files: LensFiles, by_seed: pandas.DataFrame | None) -> list[dict[str, Any]]:
    """Return an entry for each lens; `by_seed` has the rows of table 1 by seed.

    An entry has the `facts` (name, value) of a lens, the most important first; its `pictures` (data URI, text
    alternative) by name; its `files` (file name, data URI); its `margins` (limit, margin, whether it is violated); the
    paragraphs of its `manufacturability`; and the text of its `certificate`.
    """
    drawings = zip(files.sections, files.spots, files.psfs, files.curves, strict=True)
    of_lenses = zip(settings.elements, files.lenses, files.pages, drawings, files.zemax, files.catalogues, strict=True)
    gallery = []
    for lens, file, page, lens_drawings, zemax, catalogue in of_lenses:
        content, row, certificate = read_yaml(file), _row(lens, settings, by_seed), page.read_text(encoding="utf-8")
        downloads = [file, zemax, *([catalogue] if catalogue.stat().st_size else [])]
        margins = content["margins"].items()
        gallery.append(
            {
                "lens": lens,
                "by_task": lens in settings.by_task,
                "facts": _facts(content, row),
                "pictures": _pictures(lens, content["figures"], lens_drawings) | _accuracy(lens, settings, row),
                "files": [(f"{lens}{path.suffix}", pictures.link(path)) for path in downloads],
                "margins": [(name.replace("_", " "), f"{value:+.4f}", not value >= 0) for name, value in margins],
                "manufacturability": certificate.partition(_HEADING)[2].split("\n\n")[:2],
                "certificate": certificate,
            }
        )
    return gallery


def _row(lens: str, settings: ReportJob, by_seed: pandas.DataFrame | None) -> dict[str, float]:
    """Return the numbers of a lens in the first seed of table 1; empty if it is not there."""
    if by_seed is None:
        return {}
    elements, _, design = lens.partition("-")
    rows = by_seed[(by_seed["elements"] == elements) & (by_seed["design"] == design)]
    rows = rows[rows["seed"] == settings.seeds[0]].drop(columns=["elements", "design", "classifier"], errors="ignore")
    return {str(name): float(value) for name, value in rows.iloc[0].dropna().items()} if len(rows) else {}


def _facts(content: Mapping[str, Any], row: Mapping[str, float]) -> list[tuple[str, str]]:
    figures, values = content["figures"], lens_values(content)
    return [
        *((words, f"{row[name]:.1f} %") for name, words in _ACCURACIES.items() if name in row),
        ("RMS spot", f"{values['rms_spot_um']:.1f} um"),
        ("light in window", f"{100 * values['energy_in_window']:.1f} %"),
        ("focal length", f"{figures['efl_mm']:.3f} mm"),
        ("F-number", f"{figures['f_number']:.2f}"),
        ("track", f"{figures['track_mm']:.2f} mm"),
    ]


def _pictures(lens: str, figures: Mapping[str, Any], drawings: Sequence[Path]) -> dict[str, tuple[str, str]]:
    """Return the drawings; words give RMS spots, and MTF at a quarter of the Nyquist frequency."""
    order = fields_by_angle(figures)
    field_names = {order[0]: "axis", order[len(order) // 2]: "middle", order[-1]: "corner"}
    spots = (f"{name} RMS {figures['rms_centroid_um'][field]:.1f} um" for field, name in field_names.items())
    tangential, sagittal = (figures[f"mtf_{kind}_quarter_nyquist"] for kind in ("tangential", "sagittal"))
    mtf = (f"{name} T {tangential[field]:.2f}, S {sagittal[field]:.2f}" for field, name in field_names.items())
    words = {"spots": ", ".join(spots), "mtf": f"MTF at a quarter of Nyquist, {'; '.join(mtf)}", "name": lens}
    links = map(pictures.link, drawings)
    return {name: (link, _PICTURES[name].format(**words)) for name, link in zip(_PICTURES, links, strict=True)}


def _accuracy(lens: str, settings: ReportJob, row: Mapping[str, float]) -> dict[str, tuple[str, str]]:
    """Return the figure of the accuracy over the radius, if it was measured."""
    values = [(radius, row[f"{FIELD}{k}"]) for k, radius in enumerate(settings.radii) if f"{FIELD}{k}" in row]
    values = sorted([*values, *([(1.0, row["corner_accuracy"])] if "corner_accuracy" in row else [])])
    if not values:
        return {}
    words = ", ".join(f"{value:.1f} at {radius:.2f}" for radius, value in values)
    alternative = f"Accuracy [%] with {lens} over the distance from the axis, in units of that of the corner: {words}."
    return {"accuracy": (pictures.of_text(_accuracy_svg(values, settings.design_radii), ".svg"), alternative)}


def _accuracy_svg(points: Sequence[tuple[float, float]], seen: Sequence[float]) -> str:
    """Draw the accuracy over the radius; dotted lines are at `seen`, the radii of the fields that the design sees."""
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(4.5, 2), layout="constrained")
        axes = figure.subplots()
        for radius in {round(radius, 4) for radius in seen}:
            axes.axvline(radius, color="grey", linewidth=0.7, linestyle=":")
        axes.plot(*zip(*points, strict=True), "o-", color="#0072B2", markersize=3, linewidth=1.2)
        axes.set(xlabel="distance from the axis [of the corner]", ylabel="accuracy [%]", xlim=(0, 1.02))
        axes.spines[["top", "right"]].set_visible(False)
        return vector_files.svg(figure)
