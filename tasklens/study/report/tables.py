"""The paper's four tables from measurements, with the paper's values.

Columns with the paper's values end in `_paper`; these are for another data set (ImageNet) and other networks. Words,
units and decimals of columns are in `show/headings.csv`.
"""

import importlib.metadata
import re
import subprocess
from collections.abc import Iterable, Sequence
from itertools import product
from json import dumps
from pathlib import Path

import pandas

from tasklens.runtime.files import write_text
from tasklens.settings import names
from tasklens.settings.names import SHARP
from tasklens.show import headings
from tasklens.show.headings import PAPER, STD
from tasklens.show.publish import publish, title
from tasklens.study.report.measurements import FIELD, Measurements, has_failed
from tasklens.study.table_contents import TableContents

PACKAGES = ("torch", "torchvision", "timm", "kornia", "snakemake", "pandas")
_COLUMNS = {
    "table1": [
        "accuracy",
        "frozen_loss",
        "gap",
        "psnr_db",
        "rms_spot_um",
        "core_radius_um",
        "energy_in_window",
        "worst_margin",
        "failed",
    ],
    "table2": ["parameters_m", "reference_accuracy", "accuracy"],
    "table3": ["accuracy", "frozen_loss", "energy_in_window", "worst_margin", "failed"],
    "table4": ["psnr_db", "worst_psnr_db", "accuracy"],
}
_ZERO_SHOT = "zero_shot_accuracy"  # in tables 1 and 2, if a network has more outputs than classes
_ELSEWHERE = ("corner_accuracy", "accuracy_at_design_fields", "accuracy_at_nine")  # if they were measured


def collect(contents: TableContents, measurements: Measurements) -> pandas.DataFrame:
    """Return a row per lens (or `reference`), classifier and seed."""
    rows = []
    for seed, classifier in product(contents.seeds, contents.classifiers):
        sharp = measurements.values(SHARP, classifier, seed)
        if contents.name == "table1":
            sharp_values = {key: sharp[key] for key in ("accuracy", _ZERO_SHOT) if key in sharp}
            sharp_values |= _frozen_values(SHARP, (), classifier, seed, measurements)
            rows.append({"elements": "", "design": "reference", "seed": seed} | sharp_values)
        for lens in contents.lenses:
            values = measurements.values(lens, names.measured_name(classifier, contents.restored), seed)
            row = _row(lens, classifier, seed, sharp, values, measurements)
            row |= measurements.accuracy_by_field(lens, names.measured_name(classifier, contents.restored), seed)
            rows.append(row | _frozen_values(lens, contents.gaps.get(lens, ()), classifier, seed, measurements))
    return pandas.DataFrame(rows)


def _row(
    lens: str, classifier: str, seed: int, sharp: dict[str, float], metrics: dict[str, float], measured: Measurements
) -> dict[str, object]:
    """Return the row of a lens, from its metrics and those of the sharp images."""
    elements, _, design = lens.partition("-")
    values = metrics | measured.lens_values(lens, seed) | {"reference_accuracy": sharp["accuracy"]}
    lost = has_failed(values["accuracy"], sharp["accuracy"], sharp["chance"], values["energy_in_window"])
    keys = {"elements": elements, "design": design, "classifier": classifier, "seed": seed}
    return keys | values | {"failed": float(lost)}


def _frozen_values(
    lens: str, others: Iterable[str], classifier: str, seed: int, measured: Measurements
) -> dict[str, float]:
    """Return the mean loss of the frozen classifier, and its gap to the best other lens, if they are measured."""
    losses = {
        name: float(measured.frozen_losses(name, classifier, seed).mean(axis=1).mean())
        for name in (lens, *others)
        if (name, classifier, seed) in measured.frozen
    }
    if lens not in losses:
        return {}
    values = {"frozen_loss": losses.pop(lens)}
    if losses:
        values["gap"] = values["frozen_loss"] - min(losses.values())
    return values


def _columns(contents: TableContents, rows: pandas.DataFrame) -> list[str]:
    """Return the columns of values in a table."""
    columns, further = list(_COLUMNS[contents.name]), []
    if contents.name in ("table1", "table2"):
        further.append(_ZERO_SHOT)
    if contents.name in ("table1", "table3"):
        further += _ELSEWHERE
    place = columns.index("accuracy") + 1
    return [*columns[:place], *(name for name in further if name in rows), *columns[place:]]


def summarise(contents: TableContents, rows: pandas.DataFrame, paper: pandas.DataFrame) -> pandas.DataFrame:
    """Compute means over seeds, and add the paper's values.

    Margins are the worst of all seeds; `failed` is the fraction of seeds whose design failed. Several seeds add
    standard deviations (`_std`) and, in tables 1 and 3, the median accuracy and the accuracy of the seed with the best
    minival accuracy, since a mean says little about a method that can be run again.
    """
    columns = _columns(contents, rows)
    keys = ["elements", "design", *(["classifier"] if contents.name == "table2" else [])]
    groups = rows.groupby(keys, sort=False)
    table = groups.agg({c: {"worst_margin": "min"}.get(c, "mean") for c in columns})
    if len(contents.seeds) > 1:
        if "failed" in columns:
            table.insert(1, "accuracy_median", groups["accuracy"].median())
            best = rows.dropna(subset="minival_accuracy").groupby(keys, sort=False)["minival_accuracy"].idxmax()
            table.insert(2, "accuracy_best_minival", rows.loc[best].set_index(keys)["accuracy"])
        spread = groups[[c for c in columns if c not in ("failed", "worst_margin")]].std(ddof=1)
        table = table.join(spread.add_suffix(STD))
    table = table.reset_index()
    paper_rows = paper[paper["table"] == contents.name]
    published = paper_rows.pivot_table(index=keys, columns="metric", values="value", sort=False)
    shared = [c for c in columns if c in published]
    return table.merge(published[shared].add_suffix(PAPER).reset_index(), on=keys, how="left")


def make(
    settings: TableContents,
    lenses: Sequence[Path],
    metrics: Sequence[Path],
    frozen: Sequence[Path],
    csv: Path,
    md: Path,
    tex: Path,
    seeds_csv: Path,
    json: Path,
) -> None:
    """Write a table as CSV, Markdown and LaTeX, its rows by seed as CSV, and its provenance as JSON.

    Args:
        lenses, metrics, frozen: files of the keys of `settings`.
    """
    published = pandas.read_csv(Path(__file__).with_name("paper.csv"), keep_default_na=False)
    published["value"] = pandas.to_numeric(published["value"])
    measurements = Measurements(
        dict(zip(settings.lens_keys, lenses, strict=True)),
        dict(zip(settings.measured_keys, metrics, strict=True)),
        frozen=dict(zip(settings.frozen_keys, frozen, strict=True)),
    )
    rows = collect(settings, measurements)
    rows = rows.reindex(columns=list(dict.fromkeys([*rows, *_COLUMNS[settings.name], "minival_accuracy"])))
    table = summarise(settings, rows, published)
    note = f"Study `{settings.study}`. Columns marked paper: Yang et al. 2024, on ImageNet with other networks."
    publish(csv, md, table, note)
    by_field = [name for name in rows if str(name).startswith(FIELD)]
    keys = ("elements", "design", "classifier", "seed")
    columns = (*keys, *_columns(settings, rows), "reference_accuracy", "chance", *by_field)
    write_text(seeds_csv, rows[[name for name in dict.fromkeys(columns) if name in rows]].to_csv(index=False))
    caption = _caption(settings, table)
    write_text(tex, latex_table(table, caption, f"tab:{settings.study}-{settings.name}"))
    write_text(json, dumps(provenance(settings), indent=1) + "\n")


def _caption(contents: TableContents, table: pandas.DataFrame) -> str:
    """Return the caption without a number, since LaTeX numbers tables."""
    text = title(contents.name).partition(": ")[2]
    parts = [f"{text[0].upper()}{text[1:]}.", f"Study {contents.study}."]
    if any(str(name).endswith(STD) for name in table):
        parts.append("Mean ± standard deviation over seeds.")
    if any(any(headings.best(table, name)) for name in headings.columns(table)):
        parts.append(f"Bold: the best of the same elements{' and classifier' if 'classifier' in table else ''}.")
    if any(str(name).endswith(PAPER) for name in table):
        parts.append("Columns (paper): Yang et al. 2024, measured on ImageNet with other networks.")
    return " ".join(parts)


def provenance(contents: TableContents) -> dict[str, object]:
    """Return the provenance of a table: study, seeds, commit and versions."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"study": contents.study, "seeds": list(contents.seeds), "commit": commit, "versions": versions}


def latex_table(table: pandas.DataFrame, caption: str, label: str) -> str:
    """Format a table in LaTeX: words and units as headings, means with their standard deviations, the best values bold.

    Args:
        caption: plain text.
        label: LaTeX label of the table; underscores become hyphens.
    """
    names, texts = headings.columns(table), headings.texts(table)
    bold = {text: headings.best(table, name) for text, name in zip(texts, names, strict=True)}
    style = texts.style.hide(axis="index").format(escape="latex").format_index(escape="latex", axis="columns")
    style = style.apply(lambda column: ["textbf:--rwrap;" if best else "" for best in bold[str(column.name)]])
    latex = style.to_latex(
        column_format="".join("r" if headings.is_number(table[name]) else "l" for name in names),
        hrules=True,
        position_float="centering",
        caption=re.sub(r"[&%$#_{}]", r"\\\g<0>", caption),
        label=label.replace("_", "-"),
    )
    return "% Needs \\usepackage{booktabs}.\n" + latex
