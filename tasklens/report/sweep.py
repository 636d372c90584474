"""Table of a sweep: accuracies at all points, side by side."""

from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.report import headings
from tasklens.report.differences import numbers_of
from tasklens.report.publish import publish
from tasklens.study.report_jobs import SweepJob

_NOTE = """\
Study `{study}`. Accuracy [%] at each point of the sweep. The CSV file has all numbers of all tables; each point has its
own report, results/{study}/<point>/report.html."""


def collect(settings: SweepJob, tables: Sequence[Path]) -> pandas.DataFrame:
    """Return a row per number: values of the swept keys, table, row, column, value."""
    rows = [
        {"point": name, **settings.points[name], "table": table, "row": row, "column": column, "value": value}
        for (name, table), path in zip(settings.tables, tables, strict=True)
        for (row, column), value in numbers_of(path).items()
    ]
    return pandas.DataFrame(rows)


def side_by_side(numbers: pandas.DataFrame) -> pandas.DataFrame:
    """Return the accuracies as texts, with a row per row of a table, and a column per point."""
    accuracies = numbers[numbers["column"] == "accuracy"]
    texts = accuracies.assign(value=[headings.cell("accuracy", {"accuracy": v}, True) for v in accuracies["value"]])
    wide = texts.pivot_table("value", ["table", "row"], "point", aggfunc="first", sort=False)
    return wide[list(dict.fromkeys(accuracies["point"]))].reset_index()


def make(settings: SweepJob, tables: Sequence[Path], csv: Path, md: Path) -> None:
    """Write the table as CSV and Markdown; the files are those of `settings.tables`."""
    numbers = collect(settings, tables)
    note = _NOTE.format(study=settings.study)
    publish(csv, md, "Sweep", numbers.drop(columns="point"), note, side_by_side(numbers))
