"""Metrics files: rows (field, metric, value) of one classifier on the captures of one lens; no torch here."""

from pathlib import Path

import pandas


def mean_metrics(path: Path) -> dict[str, float]:
    """Read a metrics file, and return the mean over fields of every metric by name."""
    means = pandas.read_csv(path).groupby("metric")["value"].mean()
    return {str(metric): float(value) for metric, value in means.items()}
