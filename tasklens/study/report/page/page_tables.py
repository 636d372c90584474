"""Tables of the page: columns with headings and units, cells with numbers to sort by, and the best values marked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas

from tasklens.show import headings
from tasklens.show.headings import GAP, PAPER, Heading


@dataclass(frozen=True)
class Cell:
    """A cell: its text, its sort key ("" for a gap), and whether it is the best of its group or a violation."""

    text: str
    sort: float | str
    best: bool = False
    wrong: bool = False


@dataclass(frozen=True)
class Column:
    """A column: heading, whether it holds numbers, and whether its values are the paper's."""

    heading: Heading
    number: bool
    paper: bool


@dataclass(frozen=True)
class Table:
    """A table of the page."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    note: str = ""

    @property
    def paper(self) -> int:
        """Number of columns with the paper's values; they come last."""
        return sum(column.paper for column in self.columns)

    @property
    def marked(self) -> bool:
        """Whether a best value is marked."""
        return any(cell.best for row in self.rows for cell in row)


def build(key: str, caption: str, frame: pandas.DataFrame, note: str = "") -> Table:
    """Build a table from the contents of a CSV file."""
    names = headings.columns(frame)
    best = {name: headings.best(frame, name) for name in names}
    numbers = {name: headings.is_number(frame[name]) for name in names}
    columns = [Column(headings.heading(name), numbers[name], name.endswith(PAPER)) for name in names]
    rows = [
        [_cell(name, row, numbers[name], bool(best[name][k])) for name in names]
        for k, row in enumerate(frame.to_dict("records"))
    ]
    return Table(key, caption, columns, rows, note)


def _cell(name: str, row: Mapping[Any, Any], number: bool, best: bool) -> Cell:
    text = headings.cell(name, row, number)
    if text == GAP:
        return Cell(GAP, "")
    value = float(row[name]) if number else text
    return Cell(text, value, best, wrong=name == "worst_margin" and row[name] < 0)
