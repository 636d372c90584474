"""Differences between the tables of two studies, row by row."""

import csv
from dataclasses import dataclass
from pathlib import Path

_KEYS = ("elements", "design", "classifier")


@dataclass(frozen=True)
class Difference:
    """A number that differs between two tables, or that only one of them has; None in the other."""

    table: str
    row: str
    column: str
    old: float | None
    new: float | None

    def __str__(self) -> str:
        if self.old is None or self.new is None:
            return f"{self.row}  {self.column} {_shown(self.old)} -> {_shown(self.new)}"
        return f"{self.row}  {self.column} {_shown(self.old)} -> {_shown(self.new)} ({self.new - self.old:+.4g})"


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def differences(old: Path, new: Path) -> list[Difference]:
    """Compare the numbers of all tables in two folders of results; the paper's values are left out.

    Tables that are missing in one of the folders are left out too.
    """
    changes = []
    for name in common(old, new):
        before, after = (numbers_of(folder / "tables" / name) for folder in (old, new))
        for row, column in dict.fromkeys([*before, *after]):
            values = before.get((row, column)), after.get((row, column))
            if values[0] != values[1]:
                changes.append(Difference(Path(name).stem, row, column, *values))
    return changes


def common(old: Path, new: Path) -> list[str]:
    """Return the file names of the tables that both folders have."""
    return sorted(path.name for path in (old / "tables").glob("table?.csv") if (new / "tables" / path.name).exists())


def numbers_of(path: Path) -> dict[tuple[str, str], float]:
    """Read the numbers of a table by row and column."""
    numbers = {}
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name = "-".join(row[key] for key in _KEYS if row.get(key))
            for column, text in row.items():
                if column not in _KEYS and not column.endswith("_paper") and text:
                    try:
                        numbers[name, column] = float(text)
                    except ValueError:  # a word, such as a verdict
                        continue
    return numbers
