"""Zemax lens files (.zmx) of rotationally symmetric sequential lenses of even aspheres.

Supported data: standard, even and extended aspheres, the stop, clear apertures, glasses from catalogues and model
glasses, object distance, aperture, fields, wavelengths, title and comments. Data for Zemax's own analyses (weights,
solves, coatings, tolerances, merit functions) and apertures of object and image surface are ignored, so are vignetting
factors and weights of wavelengths, with a remark. Every other line is an error.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tasklens.materials.catalogues import catalogues_in_folder, write_agf
from tasklens.materials.library import Library
from tasklens.materials.zemax_text import Line, decimal, read_lines
from tasklens.optics.analysis.aiming import stop_is_inside
from tasklens.optics.io.prescription import FIELDS, Prescription, check_order
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.io.zemax_configurations import in_configuration
from tasklens.optics.io.zemax_glasses import NamedGlasses
from tasklens.optics.io.zemax_keywords import SURFACE, SYSTEM, check_surface, check_system, check_trailer
from tasklens.optics.io.zemax_surfaces import Block, limits_rays, to_lens, to_lines
from tasklens.optics.io.zemax_system import (
    ignored_data,
    read_aperture,
    read_fields,
    read_object_distance,
    read_unit,
    read_wavelengths,
)
from tasklens.runtime.files import FileError, replacing

_WAVELENGTHS = 24  # the maximum in Zemax
_ROUNDING = 1e-6  # relative rounding of radii in files
_SMALLER = 1e-3  # relative difference of radii that is worth a remark


def read(path: Path, catalogues: Sequence[Path] = (), configuration: int | None = None) -> Prescription:
    """Read the prescription from a Zemax lens file.

    `Library` looks up glasses, in `catalogues` (.agf or our YAML) and in the catalogue that `write` saved next to the
    file.

    A surface vignettes as in Zemax: by a circular or floating aperture, or, if it refracts, by a semi-diameter that is
    fixed or picked up; automatic semi-diameters do not vignette. The radius of the stop follows from the aperture
    (`stop_radius`, at the primary wavelength), or is its semi-diameter for "float by stop size". If the clear aperture
    of the stop is smaller, it is the radius, and the prescription has no aperture.

    Args:
        path: the file.
        catalogues: material files of the user.
        configuration: number of the configuration, from 1; None for the one in which the file was saved.

    Raises:
        FileError: an invalid or unsupported file; the message names the file, the line and the error.
    """
    lines = read_lines(path)
    for line in lines:
        if line.keyword == "MODE" and line.words[:1] != ["SEQ"]:
            raise line.error(
                f"expected a sequential file (SEQ), got {line.text!r}: non-sequential files are not supported"
            )
    system, blocks, trailer = _split(lines, path)
    current, contradictions = in_configuration(blocks, system, trailer, configuration)
    unit = read_unit(system)
    _check_ends(blocks)
    inner = blocks[1:-1]
    stop = _stop(inner, path)
    library = _library(path, system, catalogues)
    lens, remarks = to_lens(inner, stop, unit, library)
    # OpticStudio does not have the glasses of the catalogue next to the file.
    media = (replace(m, zemax="") if m.zemax.startswith(f"{path.stem} ") else m for m in lens.media)
    lens = replace(lens, media=tuple(media))
    check_order(lens.media, lens.thickness.tolist(), str(path), first=1)
    count = system["MNUM"].integer(0) if "MNUM" in system else 1
    if count > 1:
        remarks.append(f"configuration {current} of {count} (--configuration)")
    remarks += contradictions

    wavelengths, primary = read_wavelengths(system, path)
    remarks += ignored_data(system)
    object_distance = read_object_distance(blocks[0].line("DISZ"), unit)
    line, aperture = read_aperture(system, unit, math.isfinite(object_distance), path)
    if aperture is None:
        radius = inner[lens.stop].line("DIAM").number(0, unit)
    else:
        try:
            radius = stop_radius(lens, aperture, wavelengths[primary])
        except ValueError as error:  # a wavelength at which a glass has no index
            raise FileError(f"{path}: {error}") from None
    clear = float(lens.semi_diameter[lens.stop])
    of_stop = inner[lens.stop].lines
    follows_light = "FLAP" in of_stop and not limits_rays(of_stop)  # a floating aperture
    if not follows_light and clear < radius * (1 - _ROUNDING):
        if clear < radius * (1 - _SMALLER):
            remarks.append(
                f"clear aperture of the stop, {clear:.4g} mm: smaller than {line.keyword} gives, {radius:.4g} mm"
            )
        radius, aperture = clear, None
    if not 0 < radius < math.inf:
        raise line.error(f"the computed radius of the stop is {radius} mm, expected a positive number")
    comments = tuple(block.lines["COMM"].text if "COMM" in block.lines else "" for block in inner)
    return Prescription(
        lens=lens.with_stop_radius(radius),
        title=system["NAME"].text if "NAME" in system else "",
        comments=comments if any(comments) else None,
        aperture=aperture,
        fields=read_fields(system, unit, path),
        wavelengths_um=wavelengths,
        primary=primary,
        object_distance_mm=object_distance,
        remarks=tuple(remarks),
    )


def _library(path: Path, system: dict[str, Line], catalogues: Sequence[Path]) -> Library:
    """Return the glasses of the catalogues that a lens file lists, and of the user's catalogues; raises FileError."""
    names = system["GCAT"].text.upper().split() if "GCAT" in system else []
    own = [file for file in catalogues_in_folder(path) if file.stem.upper() in names]
    library = Library([*own, *catalogues], names)
    library.check()  # an error in a user's catalogue counts even if no glass of it is needed
    return library


def _stop(inner: list[Block], path: Path) -> int:
    """Return the index of the stop among the surfaces between object and image; raises FileError."""
    stops = [i for i, block in enumerate(inner) if "STOP" in block.lines]
    if len(stops) > 1:
        raise inner[stops[1]].lines["STOP"].error(f"expected one stop, found {len(stops)}")
    if not stops:
        raise FileError(f"{path}: expected STOP on a surface between object and image, found 0")
    return stops[0]


def _split(lines: list[Line], path: Path) -> tuple[dict[str, Line], list[Block], list[Line]]:
    """Split lines into system, surfaces (indented), and lines after the surfaces.

    Keys of the system are keywords, with a number for wavelengths and additional fields (WAVM 1 ..).

    Raises:
        FileError: an unsupported keyword that may change rays, or duplicate data.
    """
    system: dict[str, Line] = {}
    blocks: list[Block] = []
    trailer: list[Line] = []
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
            if blocks:
                check_trailer(line)
                trailer.append(line)
            else:
                check_system(line)
            if line.keyword in SYSTEM:
                several = line.keyword in ("WAVM", "FEFD")
                _add(system, f"{line.keyword} {line.integer(0)}" if several else line.keyword, line)
    if len(blocks) < 3:
        raise FileError(f"{path}: expected SURF at least for an object, a surface and an image, found {len(blocks)}")
    return system, blocks, trailer


def _add(lines: dict[Any, Line], key: object, line: Line) -> None:
    if key in lines:
        raise line.error(f"is already in {lines[key].where}; delete one of the lines")
    lines[key] = line


def _check_ends(blocks: list[Block]) -> None:
    """Check that the object is in air, and that object and image are planes; raises FileError."""
    first, last = blocks[0], blocks[-1]
    if "STOP" in last.lines or "GLAS" in last.lines or last.line("DISZ").number(0):
        raise last.head.error(
            f"surface {last.head.text}, the last one, is not an image surface (DISZ 0, no glass, no stop); is the file "
            "cut off?"
        )
    if "GLAS" in first.lines:
        raise first.lines["GLAS"].error("the object is not in air")
    for block, name in ((first, "object"), (last, "image surface")):
        if block.number("CURV", 0.0) or any(line.number(1) for line in block.numbered.values()):
            raise block.head.error(f"the {name} is curved; only planes are supported")


def write(path: Path, prescription: Prescription) -> None:
    """Write a Zemax lens file; `read` restores every number exactly.

    Glasses have their names in OpticStudio. If OpticStudio does not have a glass, or if another catalogue that the lens
    needs has a different glass of its name, the glass is written to a catalogue of the same name as the file (.agf).
    Copy this catalogue to OpticStudio's folder `Glasscat`.

    Raises:
        FileError: no fields or wavelengths, more wavelengths than Zemax allows, an aperture that does not fit the stop,
            or a text or name that the file cannot hold.
    """
    glasses = NamedGlasses.of(prescription.lens.media, path.stem)
    if glasses.own and " " in path.stem:
        raise FileError(f"{path}: the name of a Zemax catalogue cannot contain spaces; rename the file")
    text = "\r\n".join(_lines(prescription, str(path), glasses)) + "\r\n"
    if glasses.own:
        write_agf(path.with_suffix(".agf"), glasses.own)
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode("ascii" if text.isascii() else "utf-16"))


def _lines(prescription: Prescription, name: str, glasses: NamedGlasses) -> list[str]:
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
        radius = stop_radius(lens, prescription.aperture, wavelengths[primary])
        if not math.isclose(radii[lens.stop], radius, rel_tol=1e-9):
            raise FileError(f"{name}: {kind} {value} needs a stop of {radius} mm, the lens has {radii[lens.stop]}")
        aperture = f"ENPD {decimal(value)}" if kind == "entrance_pupil_diameter_mm" else f"FNUM {decimal(value)} 0"
        radii[lens.stop] = math.inf  # Zemax computes it from the aperture
    elif not math.isfinite(radii[lens.stop]):
        raise FileError(f"{name}: the lens has neither an aperture nor a radius of its stop")
    kind, points = prescription.fields
    zeros = " 0" * len(points)
    lines = [
        "VERS 190513 80 123457 L123457",
        "MODE SEQ",
        f"NAME {prescription.title}".strip(),
        "UNIT MM X W X CM MR CPMM",
    ]
    lines += [aperture, "ENVD 20 1 0", *([f"GCAT {' '.join(glasses.catalogues)}"] if glasses.catalogues else [])]
    if stop_is_inside(lens):
        lines += ["RAIM 0 2 1 1 0 0 0 0 0"]  # real rays fill the real stop, as in all our figures
    lines += [f"FTYP {FIELDS.index(kind)} 0 {len(points)} {len(wavelengths)} 0 0 0 {len(points)}"]
    lines += [f"{axis} {' '.join(decimal(point[i]) for point in points)}" for i, axis in enumerate(("XFLN", "YFLN"))]
    lines += [f"FWGN{' 1' * len(points)}", *(f"{key}{zeros}" for key in ("VDXN", "VDYN", "VCXN", "VCYN", "VANN"))]
    lines += [f"WAVM {i} {decimal(wavelength)} 1" for i, wavelength in enumerate(wavelengths, 1)]
    lines += [f"PWAV {primary + 1}"]
    near = math.isfinite(prescription.object_distance_mm)
    distance = decimal(prescription.object_distance_mm) if near else "INFINITY"
    lines += ["SURF 0", "  TYPE STANDARD", '  CURV 0 0 0 0 0 ""', f"  DISZ {distance}", '  DIAM 0 0 0 0 1 ""']
    for i, comment in enumerate(comments):
        lines += [f"SURF {i + 1}", *to_lines(lens, i, comment, radii[i], glasses.names)]
    image = f"SURF {len(lens.media) + 1}"
    return [*lines, image, "  TYPE STANDARD", '  CURV 0 0 0 0 0 ""', "  DISZ 0", '  DIAM 0 0 0 0 1 ""', "MNUM 1 1"]
