"""Reference data of the tests: files of tests/data, and more of the same in ../shared if it exists."""

import json
from functools import cache
from pathlib import Path

from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription

SHIPPED = Path(__file__).parent / "data"
SHARED = Path(__file__).parents[2] / "shared"  # larger, and in part under licences that forbid distribution


def reference_files(pattern: str) -> list[Path]:
    """Return matching files by name; ../shared wins over tests/data, which may hold only a part of the same file."""
    paths = {path.relative_to(root): path for root in (SHIPPED, SHARED / "data") for path in root.glob(pattern)}
    return [paths[name] for name in sorted(paths)]


def original_of(path: Path) -> Path:
    """Return the path in ../shared of a file of tests/data, which may have more in it."""
    name = path.relative_to(SHIPPED)
    return SHARED / name if name.parts[0] == "reference" else SHARED / "data" / name


ZEMAX_FILES = [path for path in reference_files("lenses/*/source/*") if path.suffix.lower() == ".zmx"]


@cache
def read_zemax(path: Path) -> tuple[Prescription, dict]:
    """Read one of `ZEMAX_FILES` without further catalogues, and the numbers that another program read from it."""
    return zemax.read(path), json.loads((path.parent.parent / f"{path.stem}.json").read_text())
