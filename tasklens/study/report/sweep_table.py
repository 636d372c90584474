"""Table of a sweep: accuracies at all points, side by side."""

from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.show import headings
from tasklens.show.publish import publish
from tasklens.study.report_jobs import SweepJob

_KEYS = ("elements", "design", "classifier")
_NOTE = """\
Study `{study}`. Accuracy [%] at each point of the sweep. The CSV file has all numbers of all tables; each point has its
own report, results/{study}/<point>/report.html."""


def collect(settings: SweepJob, tables: Sequence[Path]) -> pandas.DataFrame:
    """Return a row per number: values of the swept keys, table, row, column, value."""
    parts = [
        _numbers(path).assign(point=name, **settings.points[name], table=table)
        for (name, table), path in zip(settings.tables, tables, strict=True)
    ]
    swept = next(iter(settings.points.values()))
    return pandas.concat(parts, ignore_index=True)[["point", *swept, "table", "row", "column", "value"]]


def _numbers(path: Path) -> pandas.DataFrame:
    """Return the numbers of a table, one per row; the paper's values are left out."""
    table = pandas.read_csv(path, keep_default_na=False, na_values=[""], dtype=dict.fromkeys(_KEYS, str))
    keys = table[[key for key in _KEYS if key in table]]
    names = keys.apply(lambda row: "-".join(row.dropna()), axis="columns")
    columns = [name for name in map(str, table) if name not in _KEYS and not name.endswith("_paper")]
    cells = table[columns].apply(pandas.to_numeric, errors="coerce").assign(row=names).reset_index()
    numbers = cells.melt(["index", "row"], var_name="column").dropna(subset="value")
    return numbers.sort_values("index", kind="stable").drop(columns="index")


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
    publish(csv, md, numbers.drop(columns="point"), note, side_by_side(numbers))
