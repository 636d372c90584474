"""Recompute the intervals of published tables from the answers: `python docs/results/recompute.py [--write]`.

A file of answers (`*.npz`) lies beside the table of the same name (`*.csv`). `comparisons.csv` lists the differences
that pages quote and no table has, `numbers.csv` the other numbers of their tables. The program ends with 1 if a number
differs. With `--write` it first writes these two lists anew, with one decimal. `decomposition.py --check` recomputes
the decomposition.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import pandas

from tasklens.study.report import answers_file, verdicts

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


def comparisons(path: Path) -> pandas.DataFrame:
    """Return a list of comparisons with differences and intervals from the answers.

    Of several baselines, separated by spaces, the one with the best minival accuracy in each seed is compared.
    """
    table = pandas.read_csv(path)
    for k, row in table.iterrows():
        claims, packed = answers_file.read(path.parent / row["answers"])
        again = verdicts.compare(row["lens"], row["baseline"].split(), row["classifier"], claims.seeds, packed)
        table.loc[k, _NUMBERS] = again[_NUMBERS].astype(float)
    return table


def numbers(path: Path) -> pandas.DataFrame:
    """Return a list of quoted numbers with the values of their sources: a table, a lens, a network and a column."""
    table = pandas.read_csv(path, keep_default_na=False)
    return table.assign(value=[_of_table(row, path.parent) for row in table.to_dict("records")])


def list_differences(path: Path, recomputed: pandas.DataFrame) -> list[str]:
    """Return the rows of a list in which a number is not the recomputed one."""
    published = pandas.read_csv(path, keep_default_na=False)
    columns = [name for name in (*_NUMBERS, "value") if name in published]
    wrong = ((published[columns] - recomputed[columns]).abs() > _ROUNDED).any(axis=1)
    pairs = zip(published[wrong].to_dict("records"), recomputed.loc[wrong, columns].to_dict("records"), strict=True)
    return [f"{path}: {row} is {again}" for row, again in pairs]


def _of_table(row: Mapping[str, str], folder: Path) -> float:
    table = pandas.read_csv(folder / row["source"], keep_default_na=False)
    elements, _, design = row["lens"].rpartition("-")
    rows = table[(table["elements"] == elements) & (table["design"] == design)]
    if "classifier" in table:
        rows = rows[rows["classifier"] == row["classifier"]]
    return float(rows[row["column"]].item())


LISTS = {"comparisons.csv": comparisons, "numbers.csv": numbers}


def main() -> int:
    """Check all files, and print what differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write comparisons.csv and numbers.csv anew")
    options = parser.parse_args()
    packed = sorted(FOLDER.rglob("*.npz"))
    wrong = [line for path in packed for line in table_differences(path)]
    for name, function in LISTS.items():
        path = FOLDER / name
        recomputed = function(path)
        if options.write:
            recomputed.to_csv(path, index=False, float_format="%.1f")
        wrong += list_differences(path, recomputed)
    print("\n".join([*wrong, f"{len(packed)} tables and two lists recomputed: {len(wrong)} differences."]))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
