"""Durations of finished studies: of their jobs (config/durations.csv), from which runs are forecast, and of the whole.

    python benchmarks/durations.py results/small results/smoke

A rule that these studies did not run keeps its row. The whole is a row of docs/results/times.csv, which pages quote, if
one run of Snakemake made all of it.
"""

import argparse
import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path

from tasklens.runtime.files import write_text
from tasklens.study.run.forecast import MEASURED, by_rule

TIMES = MEASURED.parents[1] / "docs" / "results" / "times.csv"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path, help="folders of results")
    parser.add_argument("--table", type=Path, default=MEASURED, help="the file of jobs to write")
    parser.add_argument("--times", type=Path, default=TIMES, help="the file of studies to write")
    parser.add_argument("--commit", default="", help="the commit that made them")
    options = parser.parse_args(arguments)
    jobs, times = read(options.table, 2), read(options.times, 1)
    for folder in options.results:
        for rule, duration in by_rule(folder / "benchmarks").items():
            numbers = {"seconds": duration.seconds, "longest_s": duration.longest_s, "memory_mb": duration.memory_mb}
            words = {name: f"{value:.1f}" for name, value in numbers.items()}
            jobs[folder.name, rule] = {"study": folder.name, "rule": rule} | words
        run = json.loads((folder / "run.json").read_text())
        done = [job for job in run["jobs"].values() if job["state"] == "done" and job["started"] is not None]
        if done and len(done) == len(run["jobs"]):
            ends = [job["started"] + job["seconds"] for job in done]
            minutes = (max(ends) - min(job["started"] for job in done)) / 60
            row = {"minutes": f"{minutes:.0f}", "cores": run["cores"], "per": "", "commit": options.commit}
            times[(folder.name,)] = {"study": folder.name} | row
    write(options.table, jobs)
    write(options.times, times)


def read(path: Path, keys: int) -> dict[tuple[str, ...], dict[str, str]]:
    """Return the rows of a table by the values of their first columns."""
    with open(path, newline="") as file:
        return {tuple(row.values())[:keys]: row for row in csv.DictReader(file)}


def write(path: Path, rows: Mapping[tuple[str, ...], Mapping[str, object]]) -> None:
    """Write the rows of a table in the order of their keys."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [*next(iter(rows.values()))], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[key] for key in sorted(rows))
    write_text(path, text.getvalue())


if __name__ == "__main__":
    main()
