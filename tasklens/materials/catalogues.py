"""Reading of material files: our YAML, and Zemax's glass catalogues (.AGF)."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import yaml

from tasklens.materials.material import FORMULAS, Material, from_definitions
from tasklens.materials.zemax_text import Line, read_lines
from tasklens.runtime.files import FileError

PLASTICS = Path(__file__).parent / "plastics.yaml"  # the built-in plastics


def read(path: Path) -> dict[str, Material]:
    """Read the materials of a file, by name.

    Raises:
        FileError: an invalid file; the message names it and the error.
    """
    if path.suffix.lower() == ".agf":
        return _read_agf(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise FileError(f"{path}: expected a file of materials, .yaml or .agf")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: not valid YAML: {error}") from None
    return from_definitions(content, str(path))


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
        material = _glass(glass, path.name)
        found.setdefault(material.name, material)
    return found


def _glass(lines: dict[str, Line], source: str) -> Material:
    head = lines["NM"]
    for keyword in ("CD", "LD"):
        if keyword not in lines:
            raise head.error(f"{head.text!r} has no {keyword} line")
    formulas = [name for name in FORMULAS if name != "model"]
    which = head.integer(1)
    if not 1 <= which <= len(formulas):
        raise head.error(f"expected a dispersion formula 1 .. {len(formulas)}, found {which}")
    formula = formulas[which - 1]
    # Catalogues append or omit zero coefficients.
    given = [lines["CD"].number(i) for i in range(len(lines["CD"].words))]
    count = FORMULAS[formula][0]
    coefficients = tuple([*given, *[0.0] * count][:count])
    try:
        range_um = (lines["LD"].number(0), lines["LD"].number(1))
        return Material(head.words[0], formula, coefficients, range_um, source)
    except FileError:
        raise
    except ValueError as error:
        raise lines["LD"].error(str(error)) from None
