"""Lens files for a ranking: which of them can be used with a sensor, and how a study imports them."""

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tasklens.optics.analysis.focus import refocus
from tasklens.optics.analysis.mtf import mean_mtf
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.analysis.spots import evaluation_psf, has_light
from tasklens.optics.io import imported, lens_files
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.runtime.progress import Progress
from tasklens.settings.lens_entries import ImportedLens
from tasklens.settings.messages import validate
from tasklens.settings.names import Focus
from tasklens.settings.specification import Spec

ELEMENTS = "lens"  # name of the elements of all lenses in the study
_SUFFIXES = (".zmx", ".yaml", ".yml")
_SHIPPED = "config/lenses/phone_3p.yaml"
_RAYS = 4096  # per field and colour
_ROUNDS = 20  # of the fixed point for the scale of a lens with a near object; each gains a digit or more
_COVERAGE = 0.99  # least part of the sensor's half diagonal that the field in a lens file covers
_LONGEST = 30  # characters of a name


@dataclass
class Screened:
    """Results of screening lens files: usable lenses by name, and the reasons against the others.

    Attributes:
        entries: the lenses as a study imports them.
        titles: names of their files, by name.
        mtf: mean MTF, by name.
        left_out: reasons why a file cannot be measured, by its name.
    """

    entries: dict[str, dict[str, Any]] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)
    mtf: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def by_mtf(self) -> list[str]:
        """The lenses from the highest mean MTF to the lowest."""
        return sorted(self.entries, key=lambda lens: -self.mtf[lens])


def lens_paths(places: Sequence[Path]) -> list[Path]:
    """Return lens files, also from inside folders; raises FileError if a path does not exist."""
    files: list[Path] = []
    for path in places:
        if path.is_dir():
            inside = (file for file in sorted(path.rglob("*")) if file.suffix.lower() in _SUFFIXES)
            files += [file for file in inside if not file.name.startswith(".")]
        elif path.is_file():
            files.append(path)
        else:
            raise FileError(f"{path}: no such lens file or folder")
    if not files:
        raise FileError(f"{', '.join(map(str, places))}: no lens file there, expected {', '.join(_SUFFIXES)}")
    return list(dict.fromkeys(files))


def placeholder() -> Screened:
    """Return a published lens in place of those to be read, to check a study before they are."""
    return Screened(
        {ELEMENTS: {"elements": ELEMENTS, "file": _SHIPPED, "focus": "file"}}, {ELEMENTS: ELEMENTS}, {ELEMENTS: 0.0}
    )


def screen(
    paths: Sequence[Path], spec: Mapping[str, Any], catalogues: Sequence[Path], scaled: bool, focus: Focus | None = None
) -> Screened:
    """Read lenses, and check which of them can be used with a sensor.

    Args:
        spec: keys of `Spec`: the sensor and the distance of the object.
        catalogues: additional glass catalogues.
        scaled: scale lenses so that their field fills the sensor; otherwise they keep their size.
        focus: what sets their image planes; None: as in `ImportedLens`.

    Raises:
        InputError: a value of the sensor is invalid, or a catalogue does not exist.
    """
    lens_files.check_catalogues(catalogues)
    sensor = validate(Spec, dict(spec))
    screened = Screened()
    progress = Progress("reading lenses", len(paths))
    for step, path in enumerate(paths, 1):
        title = _title(path, paths)
        try:
            entry, mtf, remarks = _screen(path, sensor, catalogues, scaled, focus)
        except (InputError, OSError) as error:
            screened.left_out[title] = str(error).removeprefix(f"{path}: ")
        else:
            name = _name(path, screened.entries)
            screened.entries[name], screened.titles[name], screened.mtf[name] = entry, title, mtf
            for remark in remarks:
                print(f"tasklens: {path}: {remark}", file=sys.stderr)
        progress(step)
    return screened


def _screen(
    path: Path, sensor: Spec, catalogues: Sequence[Path], scaled: bool, focus: Focus | None
) -> tuple[dict[str, Any], float, Sequence[str]]:
    """Return the entry of a lens in a study, its mean MTF, and assumptions about its file; raises InputError."""
    file = lens_files.read(path, catalogues)
    check_focal_length(file.lens, sensor.wavelengths_um[1], "a ranking needs")
    efl, f_number = imported.size(file.lens, file.content.get("spec", {}), sensor.wavelengths_um[1])
    tangent, half = float(file.view.radii.max()) / file.view.efl, sensor.diagonal_mm / 2
    if not tangent:
        raise InputError("its file has no field except the axis")
    remarks = [*file.prescription.remarks]
    if _differ(file.view.wavelengths_um, sensor.wavelengths_um):
        own, others = (
            ", ".join(f"{value:g}" for value in v) for v in (file.view.wavelengths_um, sensor.wavelengths_um)
        )
        remarks.append(f"is designed for {own} um, and ranked at {others} um (--wavelengths)")
    growth = _image_scale(file.lens, sensor)
    if scaled:
        for _ in range(_ROUNDS):
            growth = _image_scale(file.lens.scaled(half / (growth * tangent * efl)), sensor)
    else:
        radius = growth * efl * tangent
        if radius < _COVERAGE * half:
            raise InputError(
                f"covers {2 * radius:.2f} mm of the sensor's diagonal of {sensor.diagonal_mm:g} mm (--scale makes it "
                "fit)"
            )
        if radius * _COVERAGE > half:
            remarks.append(f"has a field of {2 * radius:.2f} mm, used up to the sensor's diagonal of {2 * half:g} mm")
        tangent = half / (growth * efl)
    lens_spec = {
        "diagonal_mm": 2 * half / growth,  # of the image of an object at infinity, as in all specifications
        "field_of_view_deg": math.degrees(2 * math.atan(tangent)),
        "f_number": f_number,
    }
    files = {"file": str(path), "catalogues": [*map(str, catalogues)]}
    entry = {"elements": ELEMENTS, **files, "spec": lens_spec, "focus": focus}
    spec = validate(Spec, sensor.model_dump(exclude_computed_fields=True) | lens_spec)
    view = view_of_spec(spec)
    lens, details = imported.fit(validate(ImportedLens, entry), view, spec.f_number)
    if not (light := has_light(lens, view)).all():
        raise InputError(f"no light arrives at {int((~light).sum())} of {len(light)} fields")
    if (by := details["focus"]) != "file":
        lens = refocus(lens, view, "spot" if by == "spot" else "mtf")
    grid = evaluation_psf(lens, view, _RAYS)
    remarks += filter(None, [window_remark(energy_inside(grid), view.kernel_size)])
    return entry | {"focus": by}, float(mean_mtf(grid)), remarks


def _image_scale(lens: Lens, sensor: Spec) -> float:
    """Return the ratio of the image height to that for an object at infinity; raises InputError."""
    return float(image_scale(lens, view_of_spec(sensor)))


def _differ(wavelengths: Sequence[float], others: Sequence[float]) -> bool:
    """Return whether the ends of two ranges of wavelengths differ by more than a tenth."""
    ends = ((min(wavelengths), min(others)), (max(wavelengths), max(others)))
    return any(abs(a - b) > 0.1 * b for a, b in ends)


def _title(path: Path, paths: Sequence[Path]) -> str:
    """Return the name of a file, with its folder if another file has the same name."""
    namesakes = [other for other in paths if other.stem == path.stem]
    return path.stem if len(namesakes) == 1 else str(path)


def _name(path: Path, existing: Iterable[str]) -> str:
    """Return a name for a lens that the study does not use yet."""
    base = re.sub("[^a-z0-9]+", "_", path.stem.lower()).strip("_")[:_LONGEST] or "lens"
    names = [base, *(f"{base}_{k}" for k in range(2, 10_000))]
    return next(name for name in names if name not in set(existing))
