"""Make the built-in glass catalogues, `tasklens/materials/makers/*.agf`.

    python tools/glass_catalogues.py DATABASE CATALOGUE...

DATABASE is the folder `glass` of the refractiveindex.info database (public domain, CC0 1.0), which Optiland's package
contains as `optiland/database/data-nk/glass`. CATALOGUE are catalogues that makers publish for Zemax (.agf); they add
the obsolete and newer glasses that the database does not have. Their file names begin with the name of the maker.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import yaml

from tasklens.materials import catalogues
from tasklens.materials.material import FORMULAS, Material
from tasklens.runtime.files import replacing

MAKERS = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA")
MAKERS_FOLDER = catalogues.MAKERS
_POLYNOMIALS = {  # powers of the wavelength by formula, without the constant
    "schott": (2, -2, -4, -6, -8),
    "extended": (2, -2, -4, -6, -8, -10, -12),
    "extended_2": (2, -2, -4, -6, -8, 4, 6),
    "extended_3": (2, 4, -2, -4, -6, -8, -10, -12),
}
_SELLMEIER = {6: "sellmeier_1", 8: "sellmeier_3", 10: "sellmeier_5"}  # by the number of coefficients


def of_database(folder: Path) -> Iterator[Material]:
    """Yield the glasses of a maker in the database that have a dispersion formula of Zemax."""
    for path in sorted(folder.rglob("*.yml")):
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        for part in content["DATA"]:
            formula = _formula(part)
            if formula is not None:
                low, high = (float(word) for word in part["wavelength_range"].split())
                yield Material(path.stem.upper(), *formula, (low, high), "refractiveindex.info")


def _formula(part: dict) -> tuple[str, tuple[float, ...]] | None:
    """Return the formula and the coefficients of a part of the data; None if it is no formula that Zemax has."""
    kind = part["type"].strip()
    first, *others = (float(word) for word in part.get("coefficients", "0").split())
    if kind == "formula 2":  # n^2 = 1 + c0 + sum_i K_i w^2 / (w^2 - L_i)
        name = _SELLMEIER.get(max(6, len(others)))
        return None if first or name is None else (name, _filled(name, others))
    if kind == "formula 3":  # n^2 = c0 + sum_i c_i w^p_i
        terms = {power: value for value, power in zip(others[::2], others[1::2], strict=True) if value}
        for name, powers in _POLYNOMIALS.items():
            if set(terms) <= set(powers):
                return name, (first, *(terms.get(power, 0.0) for power in powers))
    return None


def _filled(name: str, coefficients: list[float]) -> tuple[float, ...]:
    return tuple([*coefficients, *[0.0] * FORMULAS[name][0]][: FORMULAS[name][0]])


def catalogue(maker: str, database: Path, published: list[Path]) -> tuple[str, list[Material]]:
    """Return the sources and the glasses of a maker, by name; the first source that has a name defines it."""
    glasses: dict[str, Material] = {}
    for glass in of_database(database / maker.lower()):
        glasses.setdefault(glass.name, glass)
    sources = ["refractiveindex.info (CC0 1.0)"]
    for path in published:
        if path.stem.upper().startswith(maker):
            sources.append(f"the maker's {path.name}")
            for glass in catalogues.read(path).values():
                glasses.setdefault(glass.name.upper(), replace(glass, name=glass.name.upper()))
    return f"{maker}: indices relative to air at 20 C; from {', '.join(sources)}", [
        glasses[name] for name in sorted(glasses)
    ]


def write(path: Path, heading: str, glasses: list[Material]) -> None:
    """Write a catalogue with only what is read from it: names, formulas, coefficients and ranges."""
    lines = [f"CC {heading}"]
    for glass in glasses:
        nd, vd = glass.abbe()
        lines += [f"NM {glass.name} {catalogues.FORMULA_NUMBERS[glass.formula]} 0 {nd:.5f} {vd:.2f} 0 0 0"]
        lines += [f"CD {' '.join(f'{value:.12g}' for value in glass.coefficients)}"]
        lines += [f"LD {glass.range_um[0]:g} {glass.range_um[1]:g}"]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(database: str, *published: str) -> None:
    """Write the catalogues of all makers."""
    for maker in MAKERS:
        heading, glasses = catalogue(maker, Path(database), [Path(path) for path in published])
        write(MAKERS_FOLDER / f"{maker}.agf", heading, glasses)
        print(f"{maker}: {len(glasses)} glasses")


if __name__ == "__main__":
    main(*sys.argv[1:])
