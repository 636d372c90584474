"""Durations of the jobs of finished studies, written as rows of config/durations.csv, from which runs are forecast.

    python benchmarks/durations.py results/small results/smoke

A rule that these studies did not run keeps its row.
"""

import argparse
import csv
import io
from pathlib import Path

from tasklens.runtime.files import write_text
from tasklens.study.run.forecast import MEASURED, by_rule

COLUMNS = ("study", "rule", "seconds", "longest_s", "memory_mb")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path, help="folders of results")
    parser.add_argument("--table", type=Path, default=MEASURED, help="the file to write")
    options = parser.parse_args(arguments)
    with open(options.table, newline="") as file:
        rows = {(row["study"], row["rule"]): row for row in csv.DictReader(file)}
    for folder in options.results:
        for rule, duration in by_rule(folder / "benchmarks").items():
            numbers = {"seconds": duration.seconds, "longest_s": duration.longest_s, "memory_mb": duration.memory_mb}
            words = {name: f"{value:.1f}" for name, value in numbers.items()}
            rows[folder.name, rule] = {"study": folder.name, "rule": rule} | words
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[key] for key in sorted(rows))
    write_text(options.table, text.getvalue())


if __name__ == "__main__":
    main()
