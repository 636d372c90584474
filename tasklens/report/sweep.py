"""Table of a sweep: accuracies at all points, side by side."""

from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.report.differences import numbers_of
from tasklens.report.publish import publish, rounded
from tasklens.study.report_jobs import SweepJob

_NOTE = """\
Study `{study}`. Accuracy [%] at each point of the sweep; the CSV file has all numbers of all tables, and each point its
own report, results/{study}/<point>/report.html."""


def collect(settings: SweepJob, tables: Sequence[Path]) -> pandas.DataFrame:
    """Return a row per number: values of the swept keys, table, row, column, value."""
    rows = [
        {"point": name, **settings.points[name], "table": table, "row": row, "column": column, "value": value}
        for (name, table), path in zip(settings.tables, tables, strict=True)
        for (row, column), value in numbers_of(path).items()
    ]
    return pandas.DataFrame(rows)


def beside(numbers: pandas.DataFrame) -> pandas.DataFrame:
    """Return the accuracies with a row per row of a table, and a column per point."""
    accuracies = numbers[numbers["column"] == "accuracy"]
    wide = accuracies.pivot_table("value", ["table", "row"], "point", sort=False)
    return wide[list(dict.fromkeys(accuracies["point"]))].reset_index()


def make(settings: SweepJob, tables: Sequence[Path], csv: Path, md: Path) -> None:
    """Write the table as CSV and Markdown; the files are those of `settings.tables`."""
    numbers = collect(settings, tables)
    texts = rounded(beside(numbers), {"": ".1f"})
    publish(csv, md, "Sweep", numbers.drop(columns="point"), texts, _NOTE.format(study=settings.study))
