"""Zemax lens files (.zmx) of rotationally symmetric sequential lenses of even aspheres.

Supported are standard, even and extended aspheres, the stop, clear apertures, glasses from catalogues and model
glasses, object distance, aperture, fields, wavelengths, title and comments. Data for Zemax's own analyses (vignetting
factors, weights, solves, coatings, tolerances, merit functions) and apertures of object and image surface are ignored.
Every other line is an error.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tasklens.materials.catalogues import collect, in_zemax, write_agf
from tasklens.materials.material import AIR, Material
from tasklens.materials.zemax_text import Line, decimal, read_lines
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.io.prescription import FIELDS, Prescription, check_order
from tasklens.optics.io.zemax_keywords import SURFACE, SYSTEM, check_configuration, check_surface, check_system
from tasklens.optics.io.zemax_surfaces import Block, to_lens, to_lines
from tasklens.optics.io.zemax_system import (
    read_aperture,
    read_fields,
    read_object_distance,
    read_unit,
    read_wavelengths,
)
from tasklens.optics.lens import Lens
from tasklens.runtime.files import FileError, replacing

_WAVELENGTHS = 24  # the maximum in Zemax
_ROUNDING = 1e-6  # of radii in files, relative


def stop_radius(lens: Lens, aperture: tuple[str, float], wavelength: float) -> float:
    """Compute the radius of the stop [mm] whose paraxial entrance pupil has the diameter D given by `aperture`.

    D / (2 r) with r the radius of the entrance pupil of a stop of radius 1. An image-space F-number is EFL / D.
    """
    semi_diameter = lens.semi_diameter.clone()
    semi_diameter[lens.stop] = 1.0
    found = paraxial(replace(lens, semi_diameter=semi_diameter), wavelength)
    kind, value = aperture
    diameter = abs(float(found.efl)) / value if kind == "f_number" else value
    return float(diameter / (2 * found.entrance_pupil_radius.double()))


def read(path: Path, catalogues: Sequence[Path] = ()) -> Prescription:
    """Read the prescription from a Zemax lens file.

    Glasses are looked up in `catalogues` (.agf or our YAML), those listed in GCAT first and in its order, in the
    catalogue that `write` put beside the file, then among the built-in plastics, by our names and OpticStudio's.

    A surface vignettes as in Zemax: by a circular or floating aperture, or a semi-diameter that is fixed or picked up;
    automatic semi-diameters do not vignette. The radius of the stop follows from the aperture (`stop_radius`, at the
    primary wavelength), or is its semi-diameter for "float by stop size". Where the stop itself vignettes at less, that
    is its radius, and the prescription has no aperture.

    Raises:
        FileError: an invalid or unsupported file; the message names the file, the line and the error.
    """
    system, blocks = _split(read_lines(path), path)
    if "MODE" in system and system["MODE"].words[:1] != ["SEQ"]:
        raise system["MODE"].error(f"expected a sequential file (SEQ), found {system['MODE'].text!r}")
    if "MNUM" in system and system["MNUM"].integer(0) > 1:
        raise system["MNUM"].error(f"{system['MNUM'].integer(0)} configurations; save the file with one")
    unit = read_unit(system)
    _check_ends(blocks)
    inner = blocks[1:-1]
    stops = [i for i, block in enumerate(inner) if "STOP" in block.lines]
    if len(stops) > 1:
        raise inner[stops[1]].lines["STOP"].error(f"expected one stop, found {len(stops)}")
    if not stops:
        raise FileError(f"{path}: expected STOP on a surface between object and image, found 0")
    named = system["GCAT"].text.upper().split() if "GCAT" in system else []
    ranked = sorted(catalogues, key=lambda file: [*named, file.stem.upper()].index(file.stem.upper()))
    own = path.with_suffix(".agf")
    if own.stem.upper() in named and own.exists():
        ranked.append(own)
    glasses = in_zemax(named) | collect(ranked)
    for name, material in glasses.items():
        if material.zemax.startswith(f"{own.stem} "):  # OpticStudio does not have it
            glasses[name] = replace(material, zemax="")
    searched = ", ".join([*(file.name for file in ranked), "the built-in plastics"])
    lens = to_lens(inner, stops[0], unit, glasses, searched)
    check_order(lens.media, lens.thickness.tolist(), str(path), first=1)

    wavelengths, primary = read_wavelengths(system, path)
    object_distance = read_object_distance(blocks[0].line("DISZ"), unit)
    line, aperture = read_aperture(system, unit, math.isfinite(object_distance), path)
    if aperture is None:
        radius = inner[lens.stop].line("DIAM").number(0, unit)
    else:
        try:
            radius = stop_radius(lens, aperture, wavelengths[primary])
        except ValueError as error:  # a wavelength at which a glass has no index
            raise FileError(f"{path}: {error}") from None
    semi_diameter = lens.semi_diameter.clone()
    clear = float(semi_diameter[lens.stop])
    if "FLAP" not in inner[lens.stop].lines and clear < radius * (1 - _ROUNDING):  # a floating one follows the light
        radius, aperture = clear, None
    if not 0 < radius < math.inf:
        raise line.error(f"the radius of the stop comes out as {radius} mm, expected a positive number")
    semi_diameter[lens.stop] = radius
    comments = tuple(block.lines["COMM"].text if "COMM" in block.lines else "" for block in inner)
    return Prescription(
        lens=replace(lens, semi_diameter=semi_diameter),
        title=system["NAME"].text if "NAME" in system else "",
        comments=comments if any(comments) else None,
        aperture=aperture,
        fields=read_fields(system, unit, path),
        wavelengths_um=wavelengths,
        primary=primary,
        object_distance_mm=object_distance,
    )


def _split(lines: list[Line], path: Path) -> tuple[dict[str, Line], list[Block]]:
    """Split lines into those of the system, by keyword (wavelengths as WAVM 1 ..), and those of surfaces (indented).

    Raises:
        FileError: a keyword that may change rays and is not read, or data that are there twice.
    """
    system: dict[str, Line] = {}
    blocks: list[Block] = []
    for line in lines:
        if line.keyword == "SURF":
            if line.integer(0) != len(blocks):
                raise line.error(f"expected surface {len(blocks)}, found {line.text!r}")
            blocks.append(Block(line, {}, {}))
        elif line.indented and blocks:
            check_surface(line)
            if line.keyword in ("PARM", "XDAT"):
                _add(blocks[-1].numbered, (line.keyword, line.integer(0)), line)
            elif line.keyword in SURFACE:
                _add(blocks[-1].lines, line.keyword, line)
            else:
                blocks[-1].lines[line.keyword] = line
        else:
            (check_configuration if blocks else check_system)(line)
            if line.keyword in SYSTEM:
                _add(system, f"WAVM {line.integer(0)}" if line.keyword == "WAVM" else line.keyword, line)
    if len(blocks) < 3:
        raise FileError(f"{path}: expected SURF of an object, a surface and an image at least, found {len(blocks)}")
    return system, blocks


def _add(found: dict[Any, Line], key: object, line: Line) -> None:
    if key in found:
        raise line.error(f"stands in {found[key].where} already; delete one of the lines")
    found[key] = line


def _check_ends(blocks: list[Block]) -> None:
    """Check that the object is in air, and that object and image surface are planes; raises FileError."""
    first, last = blocks[0], blocks[-1]
    if "GLAS" in first.lines:
        raise first.lines["GLAS"].error("the object is not in air")
    for block, name in ((first, "object"), (last, "image surface")):
        if block.number("CURV", 0.0) or any(line.number(1) for line in block.numbered.values()):
            raise block.head.error(f"the {name} is curved; only a plane is read")


def write(path: Path, prescription: Prescription) -> None:
    """Write a Zemax lens file; `read` restores every number exactly.

    A glass has the name by which OpticStudio knows it. Those that it does not know are written to a catalogue beside
    the file, of the same name (.agf), which belongs into OpticStudio's folder `Glasscat`.

    Raises:
        FileError: no fields or wavelengths, more wavelengths than Zemax allows, an aperture that does not fit the stop,
            or a text or name that the file cannot hold.
    """
    own = own_materials(prescription)
    if own and " " in path.stem:
        raise FileError(f"{path}: the name of a Zemax catalogue has no spaces; rename the file")
    text = "\r\n".join(_lines(prescription, str(path), [path.stem.upper()] if own else [])) + "\r\n"
    if own:
        write_agf(path.with_suffix(".agf"), own.values())
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode("ascii" if text.isascii() else "utf-16"))


def own_materials(prescription: Prescription) -> dict[str, Material]:
    """Return the glasses that OpticStudio does not know, by name, which `write` puts into a catalogue."""
    media = prescription.lens.media
    return {medium.name: medium for medium in media if medium != AIR and medium.formula != "model" and not medium.zemax}


def _lines(prescription: Prescription, name: str, own: list[str]) -> list[str]:
    lens, wavelengths, primary = prescription.lens, prescription.wavelengths_um, prescription.primary or 0
    comments = prescription.comments or ("",) * len(lens.media)
    if not prescription.fields or not wavelengths or len(wavelengths) > _WAVELENGTHS:
        raise FileError(f"{name}: a Zemax file needs fields, and 1 to {_WAVELENGTHS} wavelengths")
    for text in (prescription.title, *comments):
        if len(text.splitlines()) > 1 or text != text.strip():
            raise FileError(f"{name}: a title or comment is one line without spaces around it, found {text!r}")
    radii = lens.semi_diameter.tolist()
    aperture = "FLOA"
    if prescription.aperture is not None:
        kind, value = prescription.aperture
        expected = stop_radius(lens, prescription.aperture, wavelengths[primary])
        if not math.isclose(radii[lens.stop], expected, rel_tol=1e-9):
            raise FileError(f"{name}: {kind} {value} asks for a stop of {expected} mm, the lens has {radii[lens.stop]}")
        aperture = f"ENPD {decimal(value)}" if kind == "entrance_pupil_diameter_mm" else f"FNUM {decimal(value)} 0"
        radii[lens.stop] = math.inf  # Zemax computes it from the aperture
    elif not math.isfinite(radii[lens.stop]):
        raise FileError(f"{name}: the lens has neither an aperture nor a radius of its stop")
    kind, points = prescription.fields
    catalogues = dict.fromkeys([*(m.zemax.split()[0] for m in lens.media if m.zemax), *own])
    zeros = " 0" * len(points)
    lines = [
        "VERS 190513 80 123457 L123457",
        "MODE SEQ",
        f"NAME {prescription.title}".strip(),
        "UNIT MM X W X CM MR CPMM",
    ]
    lines += [aperture, "ENVD 20 1 0", *([f"GCAT {' '.join(catalogues)}"] if catalogues else [])]
    lines += [f"FTYP {FIELDS.index(kind)} 0 {len(points)} {len(wavelengths)} 0 0 0 {len(points)}"]
    lines += [f"{axis} {' '.join(decimal(point[i]) for point in points)}" for i, axis in enumerate(("XFLN", "YFLN"))]
    lines += [f"FWGN{' 1' * len(points)}", *(f"{key}{zeros}" for key in ("VDXN", "VDYN", "VCXN", "VCYN", "VANN"))]
    lines += [f"WAVM {i} {decimal(wavelength)} 1" for i, wavelength in enumerate(wavelengths, 1)]
    lines += [f"PWAV {primary + 1}"]
    near = math.isfinite(prescription.object_distance_mm)
    distance = decimal(prescription.object_distance_mm) if near else "INFINITY"
    lines += ["SURF 0", "  TYPE STANDARD", '  CURV 0 0 0 0 0 ""', f"  DISZ {distance}", '  DIAM 0 0 0 0 1 ""']
    for i, comment in enumerate(comments):
        lines += [f"SURF {i + 1}", *to_lines(lens, i, comment, radii[i])]
    image = f"SURF {len(lens.media) + 1}"
    return [*lines, image, "  TYPE STANDARD", '  CURV 0 0 0 0 0 ""', "  DISZ 0", '  DIAM 0 0 0 0 1 ""', "MNUM 1 1"]
