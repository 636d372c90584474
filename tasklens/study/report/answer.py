"""The figure that answers a study: differences of accuracy with their intervals, and the errors of every design."""

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path

import pandas
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from tasklens.runtime.files import write_text
from tasklens.show import vector_files
from tasklens.study.report.page import words

_TASK, _OTHER, _NEUTRAL = "#0072B2", "#D55E00", "#777777"  # Okabe and Ito
_LEAST = 0.02  # errors on the logarithmic axis [%]
_ROW, _FRAME = 0.24, 0.75  # height of a row, and of the frame of a panel [inches]


def draw(
    path: Path, comparisons: pandas.DataFrame, accuracies: pandas.DataFrame, task_driven: Sequence[str], sharp: float
) -> None:
    """Draw a row of two panels for each name of elements: differences at the left, errors at the right.

    Args:
        path: SVG file.
        comparisons: rows of the table of verdicts.
        accuracies: a row per lens and seed, with elements, design and accuracy [%].
        task_driven: names of the task-driven lenses.
        sharp: accuracy on images without a lens [%].
    """
    elements = list(dict.fromkeys(accuracies["elements"]))
    parts = [(name, comparisons[comparisons["lens"].str.startswith(f"{name}-")]) for name in elements]
    designs = {name: accuracies[accuracies["elements"] == name] for name in elements}
    heights = [_FRAME + _ROW * max(len(rows), designs[name]["design"].nunique()) for name, rows in parts]
    figure = Figure(figsize=(13, sum(heights)), layout="constrained")
    panels = figure.subplots(len(parts), 2, squeeze=False, sharex="col", height_ratios=heights)
    for (left, right), (name, rows) in zip(panels, parts, strict=True):
        _differences(left, rows, name)
        _errors(right, designs[name], {lens.removeprefix(f"{name}-") for lens in task_driven}, sharp)
    panels[0][0].set_title("Gain of the task-driven lens", fontsize="medium")
    panels[0][1].set_title("Wrong answers; a dot for each seed, dotted: without a lens", fontsize="medium")
    panels[-1][0].set_xlabel("difference of accuracy [points]")
    panels[-1][1].set(xlabel="wrong answers [%], fewer to the right", xscale="log")
    panels[-1][1].invert_xaxis()
    panels[-1][1].xaxis.set(major_locator=LogLocator(subs=(1, 3)), major_formatter="{x:g}")
    panels[-1][1].xaxis.set_minor_formatter(NullFormatter())
    figure.align_ylabels(panels[:, 0])
    write_text(path, vector_files.svg(figure))


def _differences(axes: Axes, rows: pandas.DataFrame, elements: str) -> None:
    """Draw differences with their intervals, in the order of the rows, grey if undecided, and a line at zero."""
    for k, row in enumerate(rows.to_dict("records")):
        colour = {words.FOR: _TASK, words.AGAINST: _OTHER}.get(words.direction_and_certainty(row, 0.0)[0], _NEUTRAL)
        axes.plot([row["low"], row["high"]], [k, k], color=colour, linewidth=2)
        axes.plot(row["difference"], k, "D", color=colour, markersize=6)
    axes.axvline(0, color="black", linewidth=1)
    _rows(axes, [_label(row, f"{elements}-") for row in rows.to_dict("records")], elements)


def _label(row: Mapping[Hashable, str], same: str) -> str:
    """Return the designs of a comparison without their elements, or the kind of baseline if seeds have several."""
    several = ", " in row["baseline"]
    baseline = row["claim"].removeprefix("more accurate than ") if several else row["baseline"].removeprefix(same)
    return f"{row['lens'].removeprefix(same)} − {baseline}"


def _errors(axes: Axes, rows: pandas.DataFrame, task_driven: set[str], sharp: float) -> None:
    """Draw a dot per seed and the mean of each design, the best one first, and a line for images without a lens."""
    errors = (100 - rows["accuracy"]).clip(lower=_LEAST)
    means = errors.groupby(rows["design"], sort=False).mean().sort_values(kind="stable")
    for k, (design, mean) in enumerate(means.items()):
        values, colour = errors[rows["design"] == design], _TASK if design in task_driven else _OTHER
        axes.plot(values, [k] * len(values), "o", color=colour, markersize=5, alpha=0.6)
        axes.plot(mean, k, "|", color=colour, markersize=14, markeredgewidth=2)
    axes.axvline(max(100 - sharp, _LEAST), color="black", linewidth=1, linestyle=":")
    _rows(axes, [str(design) for design in means.index], "")
    for label, design in zip(axes.get_yticklabels(), means.index, strict=True):
        label.set_fontweight("bold" if design in task_driven else "normal")


def _rows(axes: Axes, labels: Sequence[str], title: str) -> None:
    """Label the rows from top to bottom."""
    axes.set_yticks(range(len(labels)), labels, fontsize="small")
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(axis="x", linewidth=0.4)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylabel(title, fontsize="large")
