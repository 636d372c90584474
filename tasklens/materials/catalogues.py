"""Material files: our YAML, read, and Zemax's glass catalogues (.AGF), read and written."""

from collections.abc import Container, Iterable
from functools import cache
from pathlib import Path

from tasklens.materials.material import FORMULAS, Material, from_definitions
from tasklens.materials.zemax_text import BLANK, Line, decimal, read_lines
from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError, replacing

PLASTICS = Path(__file__).parent / "plastics.yaml"  # the built-in plastics
_FORMULAS = [name for name in FORMULAS if name != "model"]  # in the order of Zemax's numbers, from 1


def read(path: Path) -> dict[str, Material]:
    """Read the materials of a file, by name.

    Raises:
        FileError: an invalid file; the message names it and the error.
    """
    if path.suffix.lower() == ".agf":
        return _read_agf(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise FileError(f"{path}: expected a file of materials, .yaml or .agf")
    return from_definitions(yaml_files.read(path), str(path))


def collect(paths: Iterable[Path]) -> dict[str, Material]:
    """Read the materials of several files and the built-in plastics, by name; the first file with a name defines it."""
    found: dict[str, Material] = {}
    for path in paths:
        found = read(path) | found
    return _builtin() | found


def builtin(name: str) -> Material:
    """Return a built-in plastic by name; raises ValueError with the known names."""
    if name not in _builtin():
        raise ValueError(f"unknown plastic {name!r}; expected one of {', '.join(_builtin())}")
    return _builtin()[name]


def in_zemax(catalogues: Container[str]) -> dict[str, Material]:
    """Return the built-in plastics that OpticStudio has in one of some catalogues, by the name that it gives them."""
    known = {tuple(material.zemax.split()): material for material in _builtin().values() if material.zemax}
    return {name: material for (catalogue, name), material in known.items() if catalogue in catalogues}


def write_agf(path: Path, materials: Iterable[Material]) -> None:
    """Write a Zemax catalogue; `read` restores every coefficient exactly.

    Raises:
        FileError: a name that Zemax cannot have, or a source of several lines.
    """
    lines = ["CC written by TaskLens; indices relative to air"]
    for material in materials:
        check_name(material.name)
        if len(material.source.splitlines()) > 1:
            raise FileError(f"{material.name}: its source has several lines; a Zemax catalogue has room for one")
        nd, vd = material.abbe()
        lines += [f"NM {material.name} {_FORMULAS.index(material.formula) + 1} 0 {nd:.6f} {vd:.6f} 0 0 0"]
        lines += [f"GC {material.source}".strip(), "ED 0 0 0 0 0 0"]
        lines += [f"CD {' '.join(map(decimal, material.coefficients))}", "TD 0 0 0 0 0 0 20", "OD -1 -1 -1 -1 -1 -1"]
        lines += [f"LD {' '.join(map(decimal, material.range_um))}"]
    with replacing(path) as temporary:
        temporary.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8", newline="")


def check_name(name: str) -> None:
    """Raise FileError where Zemax cannot have a glass of this name."""
    if " " in name or name in ("MIRROR", BLANK):
        raise FileError(f"Zemax cannot have a glass called {name!r}; rename it")


@cache
def _builtin() -> dict[str, Material]:
    return read(PLASTICS)


def _read_agf(path: Path) -> dict[str, Material]:
    """Read a Zemax catalogue: NM begins a glass, CD holds its coefficients, LD its wavelength range."""
    glasses: list[dict[str, Line]] = []
    for line in read_lines(path):
        if line.keyword == "NM":
            glasses.append({})
        if line.keyword in ("NM", "CD", "LD"):
            if not glasses:
                raise line.error("comes before the first glass (NM)")
            glasses[-1][line.keyword] = line
    if not glasses:
        raise FileError(f"{path}: no glass (NM) in it")
    found: dict[str, Material] = {}
    for glass in glasses:
        material = _glass(glass, path)
        found.setdefault(material.name, material)
    return found


def _glass(lines: dict[str, Line], path: Path) -> Material:
    head = lines["NM"]
    for keyword in ("CD", "LD"):
        if keyword not in lines:
            raise head.error(f"{head.text!r} has no {keyword} line")
    which = head.integer(1)
    if not 1 <= which <= len(_FORMULAS):
        raise head.error(f"expected a dispersion formula 1 .. {len(_FORMULAS)}, found {which}")
    formula = _FORMULAS[which - 1]
    # Catalogues append or omit zero coefficients.
    given = [lines["CD"].number(i) for i in range(len(lines["CD"].words))]
    count = FORMULAS[formula][0]
    coefficients = tuple([*given, *[0.0] * count][:count])
    try:
        range_um = (lines["LD"].number(0), lines["LD"].number(1))
        known = f"{path.stem} {head.words[0]}" if " " not in path.stem else ""
        return Material(head.words[0], formula, coefficients, range_um, path.name, known)
    except FileError:
        raise
    except ValueError as error:
        raise lines["LD"].error(str(error)) from None
