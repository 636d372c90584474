"""Search for a glass by name in the user's catalogues, the built-in plastics, and the makers' catalogues."""

import difflib
import math
import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from tasklens.materials import catalogues
from tasklens.materials.material import Material, model_glass
from tasklens.runtime.files import FileError

FOLDER = "TASKLENS_CATALOGUES"  # environment variable: a folder of catalogues that every command reads
_CODE = re.compile(r"(\d{3})(\d{3})")
_SMALLEST = "300"  # decimals of the smallest index below 2; those of glasses from nd = 2 on are smaller
_MAKERS = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA")  # in search order
_ALIASES = {"NIKON": "HIKARI", "NIKON-HIKARI": "HIKARI"}  # other names of catalogues in OpticStudio


class UnknownGlassError(FileError):
    """No catalogue has a glass of this name."""


class Library:
    """Glasses by name.

    The search order is: the catalogues that a lens file lists, in its order; the other files of the user; the built-in
    plastics; the built-in catalogues of the makers.

    Attributes:
        remarks: choices between glasses of the same name, as text.
    """

    def __init__(self, files: Sequence[Path] = (), listed: Sequence[str] = ()) -> None:
        """Prepare a search.

        Args:
            files: material files of the user (.agf or our YAML); they precede built-in catalogues of the same name.
            listed: names of catalogues in capitals, as a lens file lists them (GCAT).
        """
        self.files = files
        self.listed = listed
        self.remarks: list[str] = []
        self._contents: dict[Path, tuple[dict[str, Material], dict[str, FileError]]] = {}

    def check(self) -> None:
        """Read all files of the user; raises FileError if one cannot be read."""
        try:
            for path in self.files:
                self._read(path)
        except OSError as error:
            raise FileError(f"{error.filename}: cannot be read: {error.strerror}") from None

    def glass(self, name: str) -> Material:
        """Return the first glass of a name.

        Six digits are a glass code: 517642 has nd = 1.517 and Vd = 64.2, and 003283 has nd = 2.003.

        Raises:
            UnknownGlassError: no glass of this name.
            FileError: its data cannot be used, or a file cannot be read.
        """
        errors: list[FileError] = []
        matches = self._matches(name, errors)  # makers' catalogues are read only if needed
        if (first := next(matches, None)) is not None:
            self._remark(first, matches)
            return first
        if errors:
            raise errors[0]
        if code := _CODE.fullmatch(name):
            whole = 2 if code[1] < _SMALLEST else 1
            return model_glass(float(f"{whole}.{code[1]}"), int(code[2]) / 10, 0.0, name)
        raise UnknownGlassError(self._describe_unknown(name))

    def _matches(self, name: str, errors: list[FileError]) -> Iterator[Material]:
        for glasses, unusable in self._sources():
            if name in glasses:
                yield glasses[name]
            elif name in unusable:
                errors.append(unusable[name])

    def _sources(self) -> Iterator[tuple[dict[str, Material], dict[str, FileError]]]:
        """Yield the glasses of all catalogues, and the errors of unusable glasses, in search order."""
        for catalogue in self.listed:
            for path in self.files:
                if path.stem.upper() == catalogue:
                    yield self._read(path)
            yield in_zemax(catalogue), {}
            if is_maker(catalogue):
                yield of_maker(catalogue), {}
        for path in self.files:
            if path.stem.upper() not in self.listed:
                yield self._read(path)
        yield catalogues.plastics(), {}
        for maker in _MAKERS:
            if maker not in self.listed:
                yield of_maker(maker), {}

    def _read(self, path: Path) -> tuple[dict[str, Material], dict[str, FileError]]:
        if path not in self._contents:
            agf = path.suffix.lower() == ".agf"
            self._contents[path] = catalogues.read_agf(path) if agf else (catalogues.read(path), {})
        return self._contents[path]

    def _remark(self, first: Material, matches: Iterator[Material]) -> None:
        """Note that another maker's glass of the same name differs, unless the lens file lists the catalogue."""
        catalogue = first.zemax.partition(" ")[0].upper()
        if catalogue not in _MAKERS or catalogue in (_ALIASES.get(name, name) for name in self.listed):
            return
        makers = [glass.zemax.partition(" ")[0] for glass in matches if glass.coefficients != first.coefficients]
        if makers:
            self.remarks.append(
                f"glass {first.name} taken from {catalogue}; other makers: {', '.join(makers)} (--catalogue)"
            )

    def _describe_unknown(self, name: str) -> str:
        names = {glass.upper(): glass for glasses, _ in self._sources() for glass in glasses}
        matches = [names[match] for match in difflib.get_close_matches(name.upper(), names, n=3, cutoff=0.6)]
        offer = f"; nearest names: {', '.join(matches)}" if matches else ""
        files = "".join(f"{path.name}, " for path in self.files)
        return (
            f"unknown glass {name!r} in {files}the built-in plastics and the catalogues {', '.join(_MAKERS)}{offer}. "
            f"Give its catalogue (--catalogue FILE or the folder {FOLDER}; in a study `materials` or `catalogues`)"
        )


def is_maker(catalogue: str) -> bool:
    """Return whether a catalogue, by its name in capitals, is one of the built-in ones of the makers."""
    return _ALIASES.get(catalogue, catalogue) in _MAKERS


@cache
def of_maker(maker: str) -> dict[str, Material]:
    """Return the glasses of a maker's built-in catalogue, by name."""
    return catalogues.read(catalogues.MAKERS / f"{_ALIASES.get(maker, maker)}.agf")


def in_zemax(catalogue: str) -> dict[str, Material]:
    """Return the built-in plastics of one of OpticStudio's catalogues, by their names in it."""
    plastics = [material for material in catalogues.plastics().values() if material.zemax]
    by_name = {tuple(material.zemax.split()): material for material in plastics}
    return {name: material for (folder, name), material in by_name.items() if folder.upper() == catalogue}


def user_files() -> list[Path]:
    """Return the catalogues in the folder of the environment variable `TASKLENS_CATALOGUES`; raises FileError."""
    folder = os.environ.get(FOLDER)
    if not folder:
        return []
    if not Path(folder).is_dir():
        raise FileError(f"{folder}: no such folder; correct the environment variable {FOLDER}")
    return sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in (".agf", ".yaml", ".yml"))


def nearest(nd: float, vd: float) -> Material:
    """Return the glass of the makers nearest to nd and Vd: one unit of Vd counts as much as 0.005 of nd."""
    glasses = [glass for maker in _MAKERS for glass in of_maker(maker).values()]
    return min(glasses, key=lambda glass: math.dist(_scale(*glass.abbe()), _scale(nd, vd)))


def _scale(nd: float, vd: float) -> tuple[float, float]:
    return nd / 0.005, vd
