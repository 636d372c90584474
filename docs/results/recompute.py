"""Recompute every published interval from the published answers: `python docs/results/recompute.py`.

A file of answers (`*.npz`) lies beside the table of the same name (`*.csv`). `comparisons.csv` lists the differences
that pages quote and no table has, `numbers.csv` the other numbers of their tables. The program ends with 1 if a number
differs.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import pandas

from tasklens.report import answers_file, verdicts

FOLDER = Path(__file__).parent
_KEYS = ["table", "claim", "lens", "baseline", "classifier"]
_NUMBERS = ["difference", "low", "high"]
_TOLERANCE = 1e-6  # points; published tables have all digits
_ROUNDED = 0.051  # points; comparisons have one decimal


def table_differences(path: Path) -> list[str]:
    """Return the rows of a table whose difference or interval is not that of the answers beside it."""
    claims, packed = answers_file.read(path)
    recomputed = verdicts.collect(claims, packed)
    published = pandas.read_csv(path.with_suffix(".csv"), keep_default_na=False)
    keys = [key for key in _KEYS if key in published]
    rows = published[published["difference"] != ""].merge(recomputed, on=keys, how="left", suffixes=("", "_again"))
    changes = [
        (rows[name].astype(float) - rows[f"{name}_again"]).abs().fillna(float("inf")) > _TOLERANCE for name in _NUMBERS
    ]
    wrong = rows[pandas.concat(changes, axis=1).any(axis=1)]
    return [f"{path.with_suffix('.csv')}: {', '.join(map(str, row))}" for row in wrong[keys].itertuples(index=False)]


def comparison_differences(path: Path) -> list[str]:
    """Return the rows of a list of comparisons whose difference or interval is not that of the answers.

    Of several baselines, separated by spaces, the one with the best minival accuracy in each seed is compared.
    """
    wrong = []
    for row in pandas.read_csv(path).to_dict("records"):
        claims, packed = answers_file.read(path.parent / row["answers"])
        again = verdicts.compare(row["lens"], row["baseline"].split(), row["classifier"], claims.seeds, packed)
        if any(abs(row[name] - again[name]) > _ROUNDED for name in _NUMBERS):
            wrong.append(f"{path}: {row} is {again[_NUMBERS].to_dict()}")
    return wrong


def number_differences(path: Path) -> list[str]:
    """Return the rows of a list of quoted numbers that are not those of their source.

    The source is a file of answers, for an accuracy [%], or a table with the column of the number.
    """
    wrong = []
    for row in pandas.read_csv(path, keep_default_na=False).to_dict("records"):
        value = _of_answers(row, path.parent) if row["source"].endswith(".npz") else _of_table(row, path.parent)
        if abs(value - float(row["value"])) > _ROUNDED:
            wrong.append(f"{path}: {row} is {value:.2f}")
    return wrong


def _of_answers(row: Mapping[str, str], folder: Path) -> float:
    claims, packed = answers_file.read(folder / row["source"])
    by_seed = [packed.correct(row["lens"], row["classifier"], seed).to_numpy().mean() for seed in claims.seeds]
    return 100 * sum(by_seed) / len(by_seed)


def _of_table(row: Mapping[str, str], folder: Path) -> float:
    table = pandas.read_csv(folder / row["source"], keep_default_na=False)
    elements, _, design = row["lens"].rpartition("-")
    rows = table[(table["elements"] == elements) & (table["design"] == design)]
    if "classifier" in table:
        rows = rows[rows["classifier"] == row["classifier"]]
    return float(rows[row["column"]].item())


def main() -> int:
    """Check all files, and print what differs."""
    packed = sorted(FOLDER.rglob("*.npz"))
    wrong = [line for path in packed for line in table_differences(path)]
    wrong += comparison_differences(FOLDER / "comparisons.csv")
    wrong += number_differences(FOLDER / "numbers.csv")
    print("\n".join([*wrong, f"{len(packed)} tables and two lists recomputed: {len(wrong)} differences."]))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
