"""Lens prescriptions and their YAML files, which preserve every float64 exactly."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import yaml

from tasklens.materials.material import AIR, Material, from_definitions
from tasklens.optics.io import lens_digest
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError, number, positive, write_text

FORMAT = 2
APERTURES = ("entrance_pupil_diameter_mm", "f_number")
FIELDS = ("angle_deg", "object_height_mm", "paraxial_image_height_mm", "real_image_height_mm")

_SYSTEM = ("title", "source", "aperture", "fields", "wavelengths_um", "primary", "object_distance_mm")
KEYS = ("format", "units", *_SYSTEM, "materials", "stop", "surfaces")

_KEYS = ("curvature", "conic", "thickness", "medium", "semi_diameter")
ORDERS = {f"alpha_{2 * j}": j for j in range(1, 241)}  # the most terms of Zemax's extended asphere


@dataclass(frozen=True)
class Prescription:
    """A lens with its aperture, fields, wavelengths and object distance; None if the file has none.

    Attributes:
        lens: the lens; `aperture`, if there is one, determines the semi-diameter of its stop.
        title: title of the file.
        comments: one per surface.
        aperture: one of `APERTURES` and its value; None if the file has the semi-diameter of the stop instead.
        fields: one of `FIELDS` and the points (x, y).
        wavelengths_um: wavelengths in the order of the file [um].
        primary: index of the reference wavelength.
        object_distance_mm: distance from the object, which is in focus, to the first surface [mm].
        remarks: assumptions made when the file was read, as text.
    """

    lens: Lens
    title: str = ""
    comments: tuple[str, ...] | None = None
    aperture: tuple[str, float] | None = None
    fields: tuple[str, tuple[tuple[float, float], ...]] | None = None
    wavelengths_um: tuple[float, ...] | None = None
    primary: int | None = None
    object_distance_mm: float = math.inf
    remarks: tuple[str, ...] = field(default=(), compare=False)


def to_dict(prescription: Prescription) -> dict:
    """Convert a prescription to plain values: lengths in mm, alpha_2j in mm^(1 - 2j).

    Raises:
        FileError: two materials have the same name.
    """
    lens = prescription.lens
    materials: dict[str, Material] = {AIR.name: AIR}
    surfaces = []
    for i, medium in enumerate(lens.media):
        if materials.setdefault(medium.name, medium) != medium:
            raise FileError(f"surface {i}: two materials are called {medium.name}; rename one")
        alpha = {f"alpha_{2 * j}": a for j, a in enumerate(lens.alpha[i].double().tolist(), 1)}
        semi = float(lens.semi_diameter[i])
        surface = {
            "curvature": float(lens.curvature[i]),
            "conic": float(lens.conic[i]),
            **alpha,
            "thickness": float(lens.thickness[i]),
            "medium": medium.name,
            "semi_diameter": semi if math.isfinite(semi) else None,
        }
        if prescription.comments is not None and prescription.comments[i]:
            surface["comment"] = prescription.comments[i]
        surfaces.append(surface)
    use: dict = {}
    if prescription.aperture is not None:
        use["aperture"] = dict([prescription.aperture])
    if prescription.fields is not None:
        kind, points = prescription.fields
        use["fields"] = {kind: [list(point) for point in points]}
    if prescription.wavelengths_um is not None:
        use["wavelengths_um"] = list(prescription.wavelengths_um)
        use["primary"] = prescription.primary
    if math.isfinite(prescription.object_distance_mm):
        use["object_distance_mm"] = prescription.object_distance_mm
    return {
        "format": FORMAT,
        "units": "mm",
        **({"title": prescription.title} if prescription.title else {}),
        **use,
        "materials": {name: material.definition() for name, material in materials.items() if material != AIR},
        "stop": lens.stop,
        "surfaces": surfaces,
    }


def from_dict(content: object, name: str = "lens file") -> Prescription:
    """Convert plain values to a prescription; the last thickness is the image distance.

    Raises:
        FileError: another format, a missing or unknown key, or an invalid value; the message begins with `name` and the
            surface.
    """
    if not isinstance(content, Mapping) or not {"units", "surfaces"} & set(content):
        raise FileError(f"{name}: not a lens: expected a lens file with format, units, surfaces, stop, materials")
    if content.get("format") != FORMAT:
        raise FileError(
            f"{name}: format {content.get('format')!r}, expected {FORMAT}; export the lens with the version of "
            "TaskLens that wrote it"
        )
    if content.get("units") != "mm":
        raise FileError(f"{name}: units {content.get('units')!r}, expected 'mm'")
    materials = from_definitions(_part(content, "materials", Mapping, name), f"{name}: materials")
    surfaces = _part(content, "surfaces", list, name)
    if not surfaces:
        raise FileError(f"{name}: surfaces: expected at least one")
    stop = _index(_part(content, "stop", int, name), len(surfaces), f"{name}: stop")
    rows = [_surface(surface, f"{name}: surface {i}") for i, surface in enumerate(surfaces)]
    if not rows[stop]["semi_diameter"] > 0:
        raise FileError(
            f"{name}: surface {stop}: semi_diameter: the radius of the stop: expected a positive number, "
            f"found {surfaces[stop]['semi_diameter']!r}; correct it, or name another stop"
        )
    orders = max((j for surface in rows for j in surface if isinstance(j, int)), default=0)
    media = []
    for i, surface in enumerate(surfaces):
        medium = surface["medium"]
        if medium != AIR.name and (not isinstance(medium, str) or medium not in materials):
            names = ", ".join([AIR.name, *materials])
            raise FileError(f"{name}: surface {i}: unknown medium {medium!r}; the file defines {names}")
        media.append(AIR if medium == AIR.name else materials[medium])
    check_order(media, [surface["thickness"] for surface in rows], name)

    def tensor(values: list) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float64)

    lens = Lens(
        curvature=tensor([surface["curvature"] for surface in rows]),
        conic=tensor([surface["conic"] for surface in rows]),
        alpha=tensor([[surface.get(j, 0.0) for j in range(1, orders + 1)] for surface in rows]),
        thickness=tensor([surface["thickness"] for surface in rows]),
        semi_diameter=tensor([surface["semi_diameter"] for surface in rows]),
        media=tuple(media),
        stop=stop,
    )
    comments = tuple(str(surface.get("comment", "")) for surface in surfaces)
    title = str(content.get("title", ""))
    return Prescription(lens, title, comments if any(comments) else None, **_system_data(content, name))


def check_order(media: Sequence[Material], thickness: Sequence[float], where: str, first: int = 0) -> None:
    """Reject glass of negative thickness, air of negative thickness between two glasses, and glass at the image.

    Args:
        media: media behind the surfaces.
        thickness: distances to the next surface [mm].
        where: the file, for error messages.
        first: number of the first surface in the file.

    Raises:
        FileError: names the surface; the message begins with `where`.
    """
    if media[-1] != AIR:
        last = first + len(media) - 1
        raise FileError(
            f"{where}: surface {last}: {media[-1].name} behind the last surface; expected air, or another surface"
        )
    for i, (medium, distance) in enumerate(zip(media, thickness, strict=True)):
        # next to neither a stop nor the image plane
        between = 0 < i < len(media) - 1 and media[i - 1] != AIR and media[i + 1] != AIR
        if distance < 0 and (medium != AIR or between):
            surface = f"{where}: surface {first + i}"
            raise FileError(f"{surface}: thickness: {distance:g} mm of {medium.name}; expected 0 or more")


def _part(content: Mapping[str, Any], key: str, kind: type, where: str) -> Any:
    if key not in content:
        raise FileError(f"{where}: has no {key}")
    if not isinstance(content[key], kind) or isinstance(content[key], bool):
        expected = {list: "a list", Mapping: "keys and values", int: "an integer"}[kind]
        raise FileError(f"{where}: {key}: expected {expected}, found {content[key]!r}")
    return content[key]


def _index(value: int, count: int, where: str) -> int:
    if not 0 <= value < count:
        raise FileError(f"{where}: expected 0 .. {count - 1}, found {value}")
    return value


def _surface(surface: object, where: str) -> dict:
    """Read the numbers of a surface by key, alpha_2j by j."""
    if not isinstance(surface, Mapping):
        raise FileError(f"{where}: expected keys and values, found {surface!r}")
    for key in _KEYS:
        if key not in surface:
            raise FileError(f"{where} has no {key}")
    numbers = {}
    for key, value in surface.items():
        if key == "semi_diameter" and value is None:
            numbers[key] = math.inf
        elif key in ORDERS or (key in _KEYS and key != "medium"):
            numbers[ORDERS.get(key, key)] = number(value, f"{where}: {key}")
        elif key not in ("medium", "comment"):
            raise FileError(f"{where} has an unknown key {key!r}")
    if numbers["semi_diameter"] < 0:
        raise FileError(f"{where}: semi_diameter: expected null or at least 0, found {surface['semi_diameter']!r}")
    return numbers


def _system_data(content: Mapping, name: str) -> dict:
    """Read aperture, fields, wavelengths and object distance if present."""
    values: dict = {}
    for key, kinds in (("aperture", APERTURES), ("fields", FIELDS)):
        if key in content:
            entry = _part(content, key, Mapping, name)
            if len(entry) != 1 or next(iter(entry)) not in kinds:
                raise FileError(f"{name}: {key}: expected one of {', '.join(kinds)}, found {entry!r}")
            values[key] = next(iter(entry.items()))
    if "aperture" in values:
        kind, value = values["aperture"]
        values["aperture"] = kind, positive(value, f"{name}: aperture: {kind}")
    if "fields" in values:
        kind, points = values["fields"]
        pairs = isinstance(points, list) and all(isinstance(point, list) and len(point) == 2 for point in points)
        if not pairs or not points:
            raise FileError(f"{name}: fields: expected a list of [x, y], found {points!r}")
        values["fields"] = kind, tuple(tuple(number(v, f"{name}: fields") for v in point) for point in points)
    if "wavelengths_um" in content:
        wavelengths = _part(content, "wavelengths_um", list, name)
        values["wavelengths_um"] = tuple(positive(value, f"{name}: wavelengths_um") for value in wavelengths)
        values["primary"] = _index(_part(content, "primary", int, name), len(wavelengths), f"{name}: primary")
    if "object_distance_mm" in content:
        values["object_distance_mm"] = positive(content["object_distance_mm"], f"{name}: object_distance_mm")
    return values


def write(path: Path, prescription: Prescription, notes: Mapping) -> None:
    """Write a lens file; `notes` (spec, origin, figures, margins) follow the prescription; figures get a digest."""
    content = to_dict(prescription) | dict(notes)
    if "figures" in notes:
        content[lens_digest.KEY] = lens_digest.digest(content)
    write_text(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def read(path: Path) -> tuple[Prescription, dict]:
    """Read a lens file: its prescription, and its whole content; raises FileError as `from_dict` does."""
    content = yaml_files.read(path)
    return from_dict(content, str(path)), content


def with_system_data(prescription: Prescription, view: View) -> Prescription:
    """Add the fields [degrees], wavelengths and object distance of `view` to a prescription that lacks them."""
    angles = torch.rad2deg(torch.atan(view.tangents)).tolist()
    changes: dict[str, Any] = {}
    if prescription.fields is None:
        changes["fields"] = "angle_deg", tuple((x, y) for x, y in angles)
    if prescription.wavelengths_um is None:
        changes |= {"wavelengths_um": tuple(view.wavelengths_um), "primary": len(view.wavelengths_um) // 2}
    if math.isinf(prescription.object_distance_mm):
        changes["object_distance_mm"] = view.object_distance
    return replace(prescription, **changes)
