"""Snakemake's benchmark files: time and memory of finished jobs."""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


class Benchmark(NamedTuple):
    """Duration [s] and largest memory [MB] of a job; 0 MB if it was too short to be measured."""

    seconds: float
    memory_mb: float


def read(path: Path) -> Benchmark | None:
    """Read the benchmark of a job; None if there is none, or if the job was killed while it ran."""
    if not path.exists():
        return None
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return Benchmark(float(rows[-1]["s"]), number(rows[-1].get("max_rss") or "")) if rows else None


def benchmarks(folder: Path) -> Iterator[tuple[str, Benchmark]]:
    """Yield the rule and the benchmark of each job of a study, from its folder of benchmarks."""
    for path in sorted(folder.rglob("*.tsv")):
        if benchmark := read(path):
            yield path.relative_to(folder).parts[0].removesuffix(".tsv"), benchmark


def number(text: str) -> float:
    """Parse a number of a file; 0 if the text is not a number."""
    try:
        return float(text)
    except ValueError:
        return 0.0
