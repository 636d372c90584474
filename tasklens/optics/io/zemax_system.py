"""System data of Zemax lens files: units, aperture, fields and wavelengths."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from tasklens.materials.zemax_text import Line
from tasklens.optics.io.prescription import FIELDS
from tasklens.runtime.files import FileError

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}  # in mm
INFINITY = 1e10  # Zemax's limit for an object at infinity [the file's unit]
_FIELDS = 12  # number of fields in a line of coordinates
_APERTURES = ("ENPD", "FNUM", "FLOA")


def read_unit(system: Mapping[str, Line]) -> float:
    """Read the file's unit of length [mm]; raises FileError."""
    if "UNIT" not in system:
        return 1.0
    unit = _UNITS.get((system["UNIT"].words or [""])[0])
    if unit is None:
        raise system["UNIT"].error(f"expected one of {', '.join(_UNITS)}, found {system['UNIT'].text!r}")
    return unit


def system_aperture(system: Mapping[str, Line]) -> Line | None:
    """Return the line of the system aperture, supported or not; None if there is none."""
    return next((system[keyword] for keyword in (*_APERTURES, "OBNA") if keyword in system), None)


def read_aperture(
    system: Mapping[str, Line], unit: float, near: bool, path: Path
) -> tuple[Line, tuple[str, float] | None]:
    """Read the system aperture and its line; None for "float by stop size".

    FNUM has a type: 0 is the F-number in image space, efl / D; 1 is the paraxial working F-number 1 / (2 tan u) of the
    marginal ray. For an object at infinity tan u = D / (2 efl), so both are equal.

    Args:
        system: lines of the system by keyword.
        unit: the file's unit of length [mm].
        near: whether the object is at a finite distance.
        path: the file, for error messages.

    Raises:
        FileError: no aperture, several, or an unsupported one.
    """
    if "OBNA" in system:
        raise system["OBNA"].error("apertures in object space are not supported; expected ENPD, FNUM or FLOA")
    apertures = [system[keyword] for keyword in _APERTURES if keyword in system]
    if not apertures:
        raise FileError(f"{path}: no aperture; expected ENPD, FNUM or FLOA")
    if len(apertures) > 1:
        raise apertures[1].error(f"the file has the aperture {apertures[0].keyword} as well; delete one of them")
    line = apertures[0]
    if line.keyword == "FLOA":
        return line, None
    value = line.number(0, unit if line.keyword == "ENPD" else 1.0)
    if not value > 0:
        raise line.error(f"expected a positive number, found {line.text!r}")
    if line.keyword == "ENPD":
        return line, ("entrance_pupil_diameter_mm", value)
    kind = line.integer(1) if len(line.words) > 1 else 0
    if kind not in (0, 1):
        raise line.error(f"expected the type 0 (image space) or 1 (paraxial working), found {line.text!r}")
    if kind == 1 and near:
        raise line.error(
            "the paraxial working F-number (type 1) is not supported for a near object; give the diameter of the "
            "entrance pupil (ENPD) or the F-number in image space (type 0)"
        )
    return line, ("f_number", value)


def read_fields(system: Mapping[str, Line], unit: float, path: Path) -> tuple[str, tuple[tuple[float, float], ...]]:
    """Read the kind of the fields and their points (x, y) [deg or mm]; raises FileError.

    The points are in XFLN and YFLN, in old files in XFLD and YFLD. These lines hold twelve points; further points are
    in lines FEFD i x y.
    """
    if "FTYP" not in system:
        raise FileError(f"{path}: no fields: FTYP is missing")
    line = system["FTYP"]  # type, telecentric, number of fields, number of wavelengths
    kind, count = line.integer(0), line.integer(2)
    if not 0 <= kind < len(FIELDS) or count < 1:
        raise line.error(f"expected a type 0 .. {len(FIELDS) - 1} and at least one field, found {line.text!r}")
    scale = 1.0 if FIELDS[kind] == "angle_deg" else unit
    x, y = (_coordinates(system, axis, path) for axis in "XY")
    per_line = min(count, _FIELDS) if f"FEFD {count}" in system else count
    points = [(x.number(i, scale), y.number(i, scale)) for i in range(per_line)]
    for i in range(1, count + 1):
        if (extra := system.get(f"FEFD {i}")) is not None:
            point = extra.number(1, scale), extra.number(2, scale)
            if i <= per_line and point != points[i - 1]:
                raise extra.error(f"differs from field {i} in {x.keyword} and {y.keyword}; save the file again")
            if i > per_line:
                points.append(point)
    return FIELDS[kind], tuple(points)


def _coordinates(system: Mapping[str, Line], axis: str, path: Path) -> Line:
    """Return the line of the fields' coordinates along an axis, X or Y."""
    for keyword in (f"{axis}FLN", f"{axis}FLD"):
        if keyword in system:
            return system[keyword]
    raise FileError(f"{path}: no fields: {axis}FLN is missing")


def read_wavelengths(system: Mapping[str, Line], path: Path) -> tuple[tuple[float, ...], int]:
    """Read the wavelengths [um] and the index of the primary one; FTYP has their number, since files list 24."""
    if "FTYP" not in system:
        raise FileError(f"{path}: the numbers of fields and wavelengths are unknown: FTYP is missing")
    count = system["FTYP"].integer(3)
    table = next((system[keyword] for keyword in ("WAVL", "WAVN") if keyword in system), None)
    words: Iterable[tuple[Line, int]]
    if count > 0 and all(f"WAVM {i}" in system for i in range(1, count + 1)):
        words = ((system[f"WAVM {i}"], 1) for i in range(1, count + 1))
    elif count > 0 and table is not None:
        words = ((table, i) for i in range(count))
    else:
        raise system["FTYP"].error(f"expected {max(count, 1)} wavelengths in WAVM, WAVL or WAVN, found fewer")
    wavelengths = []
    for line, i in words:
        wavelengths.append(line.number(i))
        if not wavelengths[-1] > 0:
            raise line.error(f"expected positive wavelengths in um, found {wavelengths[-1]}")
    primary = system["PWAV"].integer(0) if "PWAV" in system else 1
    if not 1 <= primary <= count:
        raise system["PWAV"].error(f"expected one of the {count} wavelengths, found {primary}")
    return tuple(wavelengths), primary - 1


def ignored_data(system: Mapping[str, Line]) -> list[str]:
    """Return remarks on ignored data of fields and wavelengths that change figures in Zemax; raises FileError."""
    remarks = []
    fields, colours = (system["FTYP"].integer(i) for i in (2, 3))
    factors = [system[keyword] for keyword in ("VDXN", "VDYN", "VCXN", "VCYN") if keyword in system]
    if any(line.number(i) for line in factors for i in range(min(fields, len(line.words)))):
        remarks.append("vignetting factors are ignored: light fills the stop at every field, apertures vignette")
    listed = system.get("WWGN", system.get("WWGT"))
    if listed is not None:
        weights = {listed.number(i) for i in range(min(colours, len(listed.words)))}
    else:
        lines = (system[f"WAVM {i}"] for i in range(1, colours + 1) if f"WAVM {i}" in system)
        weights = {line.number(2) for line in lines if len(line.words) > 2}
    if len(weights) > 1:
        remarks.append("weights of wavelengths are ignored: all weigh the same")
    return remarks


def read_object_distance(line: Line, unit: float) -> float:
    """Read the distance from the object to the first surface [mm], infinite beyond Zemax's limit; raises FileError."""
    distance = math.inf if line.words[:1] == ["INFINITY"] else line.number(0)
    if not distance > 0:
        raise line.error(f"expected INFINITY or a positive distance of the object, found {line.text!r}")
    return unit * distance if distance < INFINITY else math.inf
