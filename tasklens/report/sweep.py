"""The table of a sweep: accuracies at all points beside each other."""

from typing import Any

import pandas

from tasklens.report.differences import numbers_of
from tasklens.report.publish import publish, rounded
from tasklens.runtime.files import Files

_NOTE = """\
Study `{study}`. Accuracy [%] at each point of the sweep; the CSV file has all numbers of all tables, and each point its
own report, results/{study}/<point>/report.html."""


def collect(points: dict[str, dict[str, Any]], inputs: Files) -> pandas.DataFrame:
    """Return a row per number: the values of the swept keys, table, row, column, value."""
    rows = [
        {"point": name, **point, "table": table, "row": row, "column": column, "value": value}
        for name, point in points.items()
        for table, path in inputs.tables[name].items()
        for (row, column), value in numbers_of(path).items()
    ]
    return pandas.DataFrame(rows)


def beside(numbers: pandas.DataFrame) -> pandas.DataFrame:
    """Return the accuracies with a row per row of a table, and a column per point."""
    chosen = numbers[numbers["column"] == "accuracy"]
    wide = chosen.pivot_table("value", ["table", "row"], "point", sort=False)
    return wide[list(dict.fromkeys(chosen["point"]))].reset_index()


def make(settings: Any, inputs: Files, outputs: Files) -> None:
    """Write the table as CSV and Markdown."""
    numbers = collect(settings.points, inputs)
    shown = rounded(beside(numbers), {"": ".1f"})
    publish(outputs, "Sweep", numbers.drop(columns="point"), shown, _NOTE.format(study=settings.study))
