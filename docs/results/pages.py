"""Write the tables of the pages of results from the published files: `python docs/results/pages.py [--check]`.

Two comments of a page mark the place of a table. The first has its kind, an argument, and folders of docs/results with
their headings:

    <!-- accuracies: table1 | light/capture.sensor.gain=1 (daylight), light/capture.sensor.gain=16 (indoors) -->
    <!-- end -->

- `accuracies: TABLE`: accuracy [%] of each design, mean and standard deviation over seeds
- `gains: TEXT, TEXT`: differences [points] with intervals, of the claims that contain one of these texts
- `ablation: NAME`: accuracy [%] of a design and its variants, and their differences from it [points]
- `steps: COLUMN`: a column of decomposition.csv for the network that supervised the designs: `accuracy` and, in
  brackets, wrong answers [%]; `difference` [points]; the difference `inside` the corner [points]; or its `p` value
- `answer: ELEMENTS`: a row for each folder, with the accuracies and gains of decomposition.csv

In a line, `<!-- time: STUDY --><!-- end -->` is the duration of a study in times.csv, which `benchmarks/durations.py`
writes.

With `--check` the program writes nothing, and ends with 1 if a page differs.
"""

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pandas

from tasklens.show.publish import markdown

FOLDER = Path(__file__).parent
BLOCK = re.compile(r"(<!-- (\w+): ([^|\n]*) \| ([^\n]*) -->\n).*?(<!-- end -->)", re.DOTALL)
TIME = re.compile(r"(<!-- time: (\w+) -->).*?(<!-- end -->)")
_FOLDER = re.compile(r"(\S+?)(?: \((.*)\))?$")
_PARTS = ["heading", "elements", "classifier"]  # of a column of a table
Folders = Mapping[str, str]  # from folder to heading


def accuracies(table: str, folders: Folders) -> pandas.DataFrame:
    """Return the accuracies of designs, the sharp images first, then from the best to the worst."""
    rows = _read(folders, lambda folder: _accuracies(folder, table))
    rows["row"] = "`" + rows["design"] + "`"
    lenses, sharp = rows[rows["elements"] != ""], rows[rows["elements"] == ""]
    columns = lenses[_PARTS].drop_duplicates()
    sharp = columns.merge(sharp.drop(columns="elements").assign(row="sharp images"), on=["heading", "classifier"])
    best = lenses.groupby("row")["accuracy"].mean().sort_values(ascending=False).index
    values = pandas.concat([sharp, lenses]).groupby([*_PARTS, "row"], sort=False)["accuracy"]
    cells = values.mean().map("{:.1f}".format) + values.std().map(lambda std: "" if std != std else f" ± {std:.1f}")
    table = _table(cells.rename("cell").reset_index())
    return table.loc[[*sharp["row"].unique(), *best]].rename_axis("accuracy [%]")


def _accuracies(folder: Path, table: str) -> pandas.DataFrame:
    """Return the rows of a table: of each seed, or of a study of one seed."""
    path = folder / f"{table}.seeds.csv"
    rows = pandas.read_csv(path if path.exists() else folder / f"{table}.csv", keep_default_na=False)
    rows["accuracy"] = pandas.to_numeric(rows["accuracy"])
    if "classifier" not in rows:
        return rows.assign(classifier="")
    first = next(filter(None, rows["classifier"]))  # that of the sharp images of table 1, too
    return rows.assign(classifier=rows["classifier"].replace("", first))


def gains(texts: str, folders: Folders) -> pandas.DataFrame:
    """Return the differences of designs from the baselines of claims."""
    rows = _read(folders, lambda folder: pandas.read_csv(folder / "verdicts.csv")).dropna(subset="difference")
    rows = rows[[any(text in claim for text in texts.split(", ")) for claim in rows["claim"]]]
    rows[["elements", "design"]] = rows["lens"].str.split("-", n=1, expand=True)
    rows["row"] = "`" + rows["design"] + "`, " + rows["claim"].str.removeprefix("more accurate than ")
    rows["cell"] = [_interval(row) + _verdict(row.verdict) for row in rows.itertuples()]
    return _table(rows).rename_axis("gain [points] compared with")


def ablation(name: str, folders: Folders) -> pandas.DataFrame:
    """Return the accuracy of a design and its variants, and their differences from it."""
    rows = _read(folders, lambda folder: pandas.read_csv(folder / f"ablation_{name}.csv"))
    columns = {"accuracy [%]": rows["accuracy"].map("{:.1f}".format), "difference [points]": _intervals(rows)}
    return pandas.DataFrame(columns).set_axis("`" + rows["lens"] + "`").rename_axis("lens")


def steps(column: str, folders: Folders) -> pandas.DataFrame:
    """Return a column of the decomposition, with a column for each study and number of elements."""
    rows = _decomposition()
    rows = rows[rows["study"].isin([*folders]) & ((rows["fields"] == "all fields") != (column == "inside"))]
    rows = rows.drop_duplicates(["study", "elements", "step"])  # the task is compared with least squares, too
    rows = rows.assign(heading=rows["study"].map(folders), row=rows["step"])
    if column == "accuracy":
        cells = [f"{value:.1f} ({100 - value:.1f})" for value in rows["accuracy"]]
        return _table(rows.assign(cell=cells)).rename_axis("designed by")
    if column == "p":
        rows = rows.dropna(subset="p")
        return _table(rows.assign(cell=rows["p"].map("{:.2g}".format))).rename_axis("designed by")
    return _table(rows.assign(cell=_intervals(rows)).dropna(subset="difference")).rename_axis("designed by")


def answer(elements: str, folders: Folders) -> pandas.DataFrame:
    """Return a row for each folder: accuracies of least squares, image quality and a frozen network; gains."""
    rows = _decomposition()
    rows = rows[(rows["elements"] == elements) & (rows["fields"] == "all fields")]
    gains = rows[rows["compared_with"] == "best lens for image quality"].set_index(["study", "step"])
    first = rows[rows["step"] == "least squares"].set_index("study")
    table = {}
    for folder, heading in folders.items():
        frozen, jointly = ((folder, f"task, {how}") for how in ("from flat plates", "network trained jointly"))
        best = gains.loc[frozen, "accuracy"] - gains.loc[frozen, "difference"]
        accuracies = {
            "by least squares": first.loc[folder, "accuracy"],
            "for image quality": best,
            "by a frozen network": gains.loc[frozen, "accuracy"],
        }
        cells = {column: f"{value:.1f}" for column, value in accuracies.items()}
        for column, key in {"its gain": frozen, "gain of joint training": jointly}.items():
            cells[column] = _interval(gains.loc[key]) if key in gains.index else ""
        table[heading] = cells
    return pandas.DataFrame(table).T.rename_axis("measured on; lenses designed ...").rename_axis(columns=None)


def _decomposition() -> pandas.DataFrame:
    """Return the rows of decomposition.csv for the network that supervised the designs."""
    rows = pandas.read_csv(FOLDER / "decomposition.csv")
    return rows[rows["classifier"] == rows.groupby("study")["classifier"].transform("first")]


def _read(folders: Folders, read: Callable[[Path], pandas.DataFrame]) -> pandas.DataFrame:
    """Return the rows of all folders with their headings."""
    return pandas.concat([read(FOLDER / folder).assign(heading=heading) for folder, heading in folders.items()])


def _table(rows: pandas.DataFrame) -> pandas.DataFrame:
    """Return the cells with a column for each combination of `_PARTS`; its heading has the parts that vary."""
    varying = [part for part in _PARTS if rows[part].nunique() > 1] or ["elements"]
    rows = rows.assign(column=rows[varying].agg(", ".join, axis=1))
    wide = rows.pivot(index="row", columns="column", values="cell").fillna("")
    return wide.loc[rows["row"].drop_duplicates(), rows["column"].drop_duplicates()]


def _intervals(rows: pandas.DataFrame) -> pandas.Series:
    """Return differences with intervals; nothing where there is no difference."""
    return pandas.Series(["" if row.low != row.low else _interval(row) for row in rows.itertuples()], rows.index)


def _interval(row: tuple[float, ...]) -> str:
    return f"{row.difference:.1f} ({row.low:.1f} to {row.high:.1f})"


def _verdict(verdict: str) -> str:
    return "" if verdict == "holds" else ", suggested" if verdict.startswith("suggests") else f", {verdict}"


def duration(study: str) -> str:
    """Return how long a study, or each of its seeds, sets or points, took, and on how many cores."""
    row = pandas.read_csv(FOLDER / "times.csv", keep_default_na=False).set_index("study").loc[study]
    long = row["minutes"] >= 90
    time = f"{row['minutes'] / 60:.1f} hours" if long else f"{row['minutes']:.0f} minutes"
    time = "a minute" if row["minutes"] == 1 else time
    per = f" a {row['per']}" if row["per"] else ""
    cores = {1: "one core", 2: "two cores"}.get(row["cores"], f"{row['cores']} cores")
    return f"{time}{per}, {cores}"


KINDS = {"accuracies": accuracies, "gains": gains, "ablation": ablation, "steps": steps, "answer": answer}


def filled(page: str) -> str:
    """Return a page with its tables."""

    def fill(match: re.Match[str]) -> str:
        begin, kind, argument, folders, end = match.groups()
        named = [_FOLDER.match(text).groups() for text in folders.split(", ")]
        table = KINDS[kind](argument, {folder: heading or folder for folder, heading in named})
        return f"{begin}\n{markdown(table.reset_index())}\n\n{end}"

    page = TIME.sub(lambda match: f"{match[1]}{duration(match[2])}{match[3]}", page)
    return BLOCK.sub(fill, page)


def main() -> int:
    """Write or check all pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    named = (FOLDER.parent / f"{name}.md" for name in ("results", "study", "tutorial"))
    pages = [FOLDER.parents[1] / "README.md", *named, *sorted(FOLDER.glob("*/README.md"))]
    different = [page for page in pages if page.read_text() != filled(page.read_text())]
    for page in different:
        if options.check:
            print(f"{page}: a table differs; run `python docs/results/pages.py`")
        else:
            page.write_text(filled(page.read_text()))
    return int(options.check and bool(different))


if __name__ == "__main__":
    sys.exit(main())
