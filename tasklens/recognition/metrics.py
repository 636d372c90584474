"""Metrics files: rows (field, metric, value) of one classifier on the captures of one lens. Does not import torch."""

from pathlib import Path

import pandas

from tasklens.runtime.files import damage_error, read_table

_GRADED = ("accuracy", "zero_shot_accuracy", "psnr_db", "worst_psnr_db")  # all at the fields of the grading


def mean_metrics(path: Path) -> dict[str, float]:
    """Read a metrics file, and return the mean over fields of every metric by name; raises FileError if damaged."""
    return {str(metric): float(value) for metric, value in _values(path).groupby(level=0).mean().items()}


def accuracy_by_field(path: Path) -> list[float]:
    """Read a metrics file, and return the accuracy [%] at each field; raises FileError if damaged."""
    return [float(value) for value in _values(path).loc["accuracy"].sort_index()]


def worst_field_metrics(path: Path) -> dict[str, float]:
    """Read a metrics file, and return the minimum over fields of every metric by name; raises FileError if damaged."""
    return {str(metric): float(value) for metric, value in _values(path).groupby(level=0).min().items()}


def _values(path: Path) -> pandas.Series:
    """Read the values of a metrics file, by metric and field.

    Raises:
        FileError: the file is not a metrics file: it has other columns, a value is not a number, or a metric lacks a
            field.
    """
    try:
        rows = read_table(path)
        fields, values = pandas.to_numeric(rows["field"]), pandas.to_numeric(rows["value"])
    except (KeyError, ValueError) as error:
        raise damage_error(path, f"not a table of metrics ({error})") from None
    if rows.empty or values.isna().any():
        raise damage_error(path, "a value is missing")
    by_metric = {str(metric): numbers for metric, numbers in fields.dropna().groupby(rows["metric"])}
    graded = max((len(numbers) for metric, numbers in by_metric.items() if metric in _GRADED), default=0)
    for metric, numbers in by_metric.items():
        if sorted(numbers) != list(range(graded if metric in _GRADED else len(numbers))):
            raise damage_error(path, f"{metric} has the fields {', '.join(f'{field:g}' for field in sorted(numbers))}")
    return values.set_axis(pandas.MultiIndex.from_arrays([rows["metric"], fields]))
