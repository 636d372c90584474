"""Entries of the gallery: drawings, numbers, limits and files of each lens."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas

from tasklens.runtime.files import read_yaml
from tasklens.show import pictures
from tasklens.show.glance import fields_by_angle
from tasklens.study.report import by_radius
from tasklens.study.report.measurements import lens_values
from tasklens.study.report.page.page_files import PageFiles
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
class Entry:
    """An entry of the gallery; pictures and files are data URIs by name.

    Attributes:
        lens: name of the lens.
        elements: name of its elements.
        by_task: whether a classifier designed it.
        facts: short facts (name, value), the most important first.
        pictures: (data URI, text alternative) by name.
        files: (file name, data URI) of downloads.
        margins: (limit, margin, whether it is violated).
        manufacturability: paragraphs of the certificate.
        certificate: text of the whole certificate.
    """

    lens: str
    elements: str
    by_task: bool
    facts: list[tuple[str, str]]
    pictures: dict[str, tuple[str, str]]
    files: list[tuple[str, str]]
    margins: list[tuple[str, str, bool]]
    manufacturability: list[str]
    certificate: str


def entries(settings: ReportJob, files: PageFiles, by_seed: pandas.DataFrame | None) -> list[Entry]:
    """Return an entry for each lens; `by_seed` has the rows of table 1 by seed."""
    return [_entry(lens, settings, files, _row(lens, settings, by_seed)) for lens in settings.elements]


def _row(lens: str, settings: ReportJob, by_seed: pandas.DataFrame | None) -> dict[str, float]:
    """Return the numbers of a lens in the first seed of table 1; empty if it is not there."""
    if by_seed is None:
        return {}
    elements, _, design = lens.partition("-")
    rows = by_seed[(by_seed["elements"] == elements) & (by_seed["design"] == design)]
    rows = rows[rows["seed"] == settings.seeds[0]].drop(columns=["elements", "design", "classifier"], errors="ignore")
    return {str(name): float(value) for name, value in rows.iloc[0].dropna().items()} if len(rows) else {}


def _entry(lens: str, settings: ReportJob, files: PageFiles, row: Mapping[str, float]) -> Entry:
    content = read_yaml(files.lenses[lens])
    figures, margins = content["figures"], content["margins"]
    page = files.pages[lens].read_text(encoding="utf-8")
    words = _words(figures) | {"name": lens}
    return Entry(
        lens=lens,
        elements=settings.elements[lens],
        by_task=lens in settings.by_task,
        facts=_facts(content, row),
        pictures={
            name: (pictures.link(files.pictures[name][lens]), alternative.format(**words))
            for name, alternative in _PICTURES.items()
        }
        | _accuracy(lens, settings, row),
        files=[(f"{lens}{path.suffix}", pictures.link(path)) for path in _files(files, lens)],
        margins=[(name.replace("_", " "), f"{value:+.4f}", not value >= 0) for name, value in margins.items()],
        manufacturability=page.partition(_HEADING)[2].split("\n\n")[:2] if _HEADING in page else [],
        certificate=page,
    )


def _files(files: PageFiles, lens: str) -> list[Path]:
    """Return the files of a lens: YAML, Zemax, and the glass catalogue of the Zemax file if it needs one."""
    catalogue = files.catalogues[lens]
    return [files.lenses[lens], files.zemax[lens], *([catalogue] if catalogue.stat().st_size else [])]


def _accuracy(lens: str, settings: ReportJob, row: Mapping[str, float]) -> dict[str, tuple[str, str]]:
    """Return the figure of the accuracy over the radius, if it was measured."""
    if not (values := by_radius.points(row, settings.radii)):
        return {}
    words = ", ".join(f"{value:.1f} at {radius:.2f}" for radius, value in values)
    drawing = by_radius.svg(row, settings.radii, settings.design_radii)
    return {
        "accuracy": (
            pictures.of_text(drawing, ".svg"),
            f"Accuracy [%] with {lens} over the distance from the axis, in units of that of the corner: {words}.",
        )
    }


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


def _words(figures: Mapping[str, Any]) -> dict[str, str]:
    """Describe the drawings in words: RMS spots, and MTF at a quarter of the Nyquist frequency."""
    order = fields_by_angle(figures)
    field_names = {order[0]: "axis", order[len(order) // 2]: "middle", order[-1]: "corner"}
    spots = (f"{name} RMS {figures['rms_centroid_um'][field]:.1f} um" for field, name in field_names.items())
    tangential, sagittal = (figures[f"mtf_{kind}_quarter_nyquist"] for kind in ("tangential", "sagittal"))
    mtf = (f"{name} T {tangential[field]:.2f}, S {sagittal[field]:.2f}" for field, name in field_names.items())
    return {"spots": ", ".join(spots), "mtf": f"MTF at a quarter of Nyquist, {'; '.join(mtf)}"}
