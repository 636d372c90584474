"""Reading of our YAML material files; reading and writing of Zemax's glass catalogues (.AGF)."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path

from tasklens.materials.material import FORMULAS, Material, from_definitions
from tasklens.materials.zemax_text import BLANK, Line, decimal, read_lines
from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError, replacing

PLASTICS = Path(__file__).parent / "plastics.yaml"  # the built-in plastics
MAKERS = Path(__file__).parent / "makers"  # the built-in catalogues, made by tools/glass_catalogues.py
FORMULA_NUMBERS = {name: number for number, name in enumerate(FORMULAS, 1) if name != "model"}  # Zemax's
_HEAD = "CC written by TaskLens; indices relative to air"
_BY_NUMBER = {number: name for name, number in FORMULA_NUMBERS.items()}


def read(path: Path) -> dict[str, Material]:
    """Read the materials of a file, by name.

    Raises:
        FileError: an invalid file; the message names it and the error. Glasses of a Zemax catalogue with unusable data
            are left out, unless no other is left.
    """
    if path.suffix.lower() == ".agf":
        return read_agf(path)[0]
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise FileError(f"{path}: expected a file of materials, .yaml or .agf")
    return from_definitions(yaml_files.read(path), str(path))


def catalogues_in_folder(path: Path) -> list[Path]:
    """Return the Zemax catalogues in the folder of a lens file."""
    return sorted(file for file in path.parent.glob("*") if file.suffix.lower() == ".agf")


@cache
def plastics() -> dict[str, Material]:
    """Return the built-in plastics, by name."""
    return read(PLASTICS)


def builtin(name: str) -> Material:
    """Return a built-in plastic by name; raises ValueError that lists the names if there is none."""
    if name not in plastics():
        raise ValueError(f"unknown plastic {name!r}; expected one of {', '.join(plastics())}")
    return plastics()[name]


def is_ours(path: Path) -> bool:
    """Return whether `write_agf` wrote a catalogue."""
    return path.read_bytes().startswith(_HEAD.encode())


def write_agf(path: Path, materials: Iterable[Material]) -> None:
    """Write a Zemax catalogue; `read` restores every coefficient exactly.

    Raises:
        FileError: a name that Zemax cannot have, or a source of several lines.
    """
    lines = [_HEAD]
    for material in materials:
        if " " in material.name or material.name in ("MIRROR", BLANK):
            raise FileError(f"Zemax cannot have a glass called {material.name!r}; rename it")
        if len(material.source.splitlines()) > 1:
            raise FileError(f"{material.name}: its source has several lines; a Zemax catalogue has room for one")
        nd, vd = material.abbe()
        lines += [f"NM {material.name} {FORMULA_NUMBERS[material.formula]} 0 {nd:.6f} {vd:.6f} 0 0 0"]
        lines += [f"GC {material.source}".strip(), "ED 0 0 0 0 0 0"]
        lines += [f"CD {' '.join(map(decimal, material.coefficients))}", "TD 0 0 0 0 0 0 20", "OD -1 -1 -1 -1 -1 -1"]
        lines += [f"LD {' '.join(map(decimal, material.range_um))}"]
    with replacing(path) as temporary:
        temporary.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8", newline="")


def read_agf(path: Path) -> tuple[dict[str, Material], dict[str, FileError]]:
    """Read a Zemax catalogue; returns its glasses, and the errors of glasses with unusable data, by name.

    NM begins a glass, CD holds its coefficients, LD its wavelength range. The first glass of a name counts.

    Raises:
        FileError: no usable glass, or data before the first glass.
    """
    entries: list[dict[str, Line]] = []
    for line in read_lines(path):
        if line.keyword == "NM":
            entries.append({})
        if line.keyword in ("NM", "CD", "LD"):
            if not entries:
                raise line.error("comes before the first glass (NM)")
            entries[-1][line.keyword] = line
    if not entries:
        raise FileError(f"{path}: has no glass (NM)")
    glasses: dict[str, Material] = {}
    errors: dict[str, FileError] = {}
    for entry in entries:
        name = (entry["NM"].words or [""])[0]
        if name not in glasses:
            try:
                glasses[name] = _glass(entry, path)
            except FileError as error:
                errors.setdefault(name, error)
    if not glasses:
        raise next(iter(errors.values()))
    return glasses, {name: error for name, error in errors.items() if name not in glasses}


def _glass(lines: dict[str, Line], path: Path) -> Material:
    head = lines["NM"]
    for keyword in ("CD", "LD"):
        if keyword not in lines:
            raise head.error(f"{head.text!r} has no {keyword} line")
    number = head.integer(1)
    if number not in _BY_NUMBER:
        raise head.error(f"expected a dispersion formula 1 .. {len(_BY_NUMBER)}, got {number}")
    formula = _BY_NUMBER[number]
    # Catalogues append or omit zero coefficients.
    values = [lines["CD"].number(i) for i in range(len(lines["CD"].words))]
    count = FORMULAS[formula][0]
    coefficients = tuple([*values, *[0.0] * count][:count])
    range_um = (lines["LD"].number(0), lines["LD"].number(1))
    zemax = f"{path.stem} {head.words[0]}" if " " not in path.stem else ""
    try:
        return Material(head.words[0], formula, coefficients, range_um, path.name, zemax)
    except ValueError as error:
        raise lines["LD"].error(str(error)) from None
