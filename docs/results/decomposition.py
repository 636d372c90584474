"""Decompose the gain of task-driven design: `python docs/results/decomposition.py STUDY [STUDY ...] [--check]`.

From least squares to squared error or PSNR, to image correlation, to the same with a heavier weight of the corner, to
the error after the best linear filter: accuracy of each step and its difference from the step before. Then four kinds
of task-driven design, each compared with the best lens for image quality, and with least squares. Intervals are over
seeds and images (95 %). A sweep over `images.seed` counts as one study, with Student's interval over its points, and
p-values of the task-driven kinds after Holm's correction. There are also the differences at the paper's nine fields or,
for lenses that were designed and graded only there, without the corner field; and the lowest and highest difference
without one of the fields.

The program reads the published answers of studies (folders of docs/results), and writes decomposition.csv, of all
networks, and decomposition.svg, of the network that supervised the designs.
With `--check` it writes nothing, and ends with 1 if the rows of a study differ from those in decomposition.csv.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import matplotlib
import pandas
from matplotlib.figure import Figure
from scipy.stats import t

from tasklens.fields import PAPER
from tasklens.show import bootstrap, vector_files
from tasklens.study.report import answers_file, verdicts
from tasklens.study.report.answers_file import PackedMeasurements

FOLDER = Path(__file__).parent
STEPS = {  # designs of each step; of several, the one with the best minival accuracy in each seed
    "least squares": ("imaging2", "imaging3", "imaging_vignetted"),
    "squared error or PSNR": ("image_psnr", "image_error"),
    "image correlation": ("image_correlation", "image_correlation_flat"),
    "image correlation, corner weighted": ("image_corner", "image_centre"),
    "error after the best linear filter": ("image_wiener",),
    "task, from flat plates": ("tasklens",),
    "task, from an image-quality lens": ("tasklens_from_quality",),
    "task, network trained jointly": ("tasklens_joint",),
    "task, from flat plates, then jointly": ("tasklens_joint_from_flat",),
}
QUALITY = (
    *("image_psnr", "image_error", "image_contrast"),
    *("image_correlation", "image_correlation_flat", "image_corner", "image_centre", "image_wiener"),
)
_FIRST = "least squares"
_BEST = "best lens for image quality"
_ALL, _WITHOUT, _NINE = "all fields", "without the corner", "the paper's nine fields"
_KEYS = ["study", "elements", "classifier", "step", "compared_with", "fields"]


def rows(study: str) -> pandas.DataFrame:
    """Return a row for each number of elements, network, step and set of fields of a study."""
    points = sorted((FOLDER / study).glob("images.seed=*/verdicts.npz"))
    if len(points) < 2:
        return rows_of_file(study, next(iter(points), FOLDER / study / "verdicts.npz"))
    groups = pandas.concat([rows_of_file(study, path) for path in points]).groupby(_KEYS, sort=False)
    table = groups[["accuracy", "difference", "lowest", "highest"]].mean()
    error, freedom = groups["difference"].sem(), len(points) - 1
    half = t.ppf(0.975, freedom) * error
    table = table.assign(low=table["difference"] - half, high=table["difference"] + half)
    tested = [key for key in table.index if key[-2:] == (_BEST, _ALL)]
    p_values = 2 * t.sf((table["difference"] / error).abs()[tested], freedom)
    table.loc[tested, "p"] = bootstrap.holm(list(p_values))
    table = table.assign(median=groups["difference"].median(), above=groups["above"].sum(), seeds=len(points))
    return table.reset_index()


def rows_of_file(study: str, path: Path) -> pandas.DataFrame:
    """Return these rows from a file."""
    claims, packed = answers_file.read(path)
    measured = dict.fromkeys((lens, name) for lens, name, _ in packed.answers if "-" in lens and "-" not in name)
    table = []
    for elements, classifier in dict.fromkeys((lens.partition("-")[0], name) for lens, name in measured):
        before, chosen = "", packed
        for step, designs in {**STEPS, _BEST: QUALITY}.items():
            lenses = [lens for name in designs if (lens := f"{elements}-{name}", classifier) in measured]
            chosen = _choose(step, lenses, classifier, chosen, claims.seeds) if lenses else chosen
        fields = [(_ALL, chosen)]
        if chosen.at_nine:
            fields.append((_NINE, replace(chosen, answers=chosen.at_nine)))
        elif len(PAPER) in {frame.shape[1] for frame in packed.answers.values()}:
            fields.append((_WITHOUT, _without(chosen, -1)))
        steps = [step for step in (*STEPS, _BEST) if (step, classifier, claims.seeds[0]) in chosen.answers]
        for step in (step for step in steps if step != _BEST):
            by_task = step.startswith("task")
            others = [name for name in (_BEST, _FIRST) if name in steps] if by_task else [before]
            for other, (place, measurements) in product(others, fields):
                keys = dict(zip(_KEYS, (study, elements, classifier, step, other), strict=False))
                row = keys | {"fields": place, "seeds": len(claims.seeds)}
                row["accuracy"] = _accuracy(step, classifier, measurements, claims.seeds)
                if other:
                    row |= _difference(step, other, classifier, measurements, claims.seeds)
                if other and place == _ALL:
                    row |= _range(step, other, classifier, chosen, claims.seeds)
                table.append(row)
            before = before if by_task else step
    return pandas.DataFrame(table)


def _choose(
    name: str, lenses: Sequence[str], classifier: str, packed: PackedMeasurements, seeds: Sequence[int]
) -> PackedMeasurements:
    """Return the measurements with a further lens: in each seed the one of these with the best minival accuracy."""
    answers, accuracies, at_nine = dict(packed.answers), dict(packed.accuracies), dict(packed.at_nine)
    for seed in seeds:
        best = max(lenses, key=lambda lens: packed.accuracies[lens, classifier, seed]["minival_accuracy"])
        answers[name, classifier, seed] = packed.answers[best, classifier, seed]
        accuracies[name, classifier, seed] = packed.accuracies[best, classifier, seed]
        if (best, classifier, seed) in at_nine:
            at_nine[name, classifier, seed] = at_nine[best, classifier, seed]
    return replace(packed, answers=answers, accuracies=accuracies, at_nine=at_nine)


def _without(packed: PackedMeasurements, field: int) -> PackedMeasurements:
    """Return the measurements without a field; those of sharp images have one field, and keep it."""
    frames = {
        key: frame.drop(columns=frame.columns[field]) if frame.shape[1] > 1 else frame
        for key, frame in packed.answers.items()
    }
    return replace(packed, answers=frames)


def _accuracy(lens: str, classifier: str, packed: PackedMeasurements, seeds: Sequence[int]) -> float:
    """Return the accuracy [%], mean over seeds."""
    return 100 * sum(packed.correct(lens, classifier, seed).to_numpy().mean() for seed in seeds) / len(seeds)


def _difference(
    lens: str, baseline: str, classifier: str, packed: PackedMeasurements, seeds: tuple[int, ...]
) -> Mapping[str, float]:
    """Return the difference of two lenses [points] with its interval."""
    row = verdicts.compare(lens, [baseline], classifier, seeds, packed)
    return {name: float(row[name]) for name in ("difference", "low", "high", "median", "above")}


def _range(
    lens: str, baseline: str, classifier: str, packed: PackedMeasurements, seeds: Sequence[int]
) -> Mapping[str, float]:
    """Return the lowest and highest difference [points] without one of the fields."""
    differences = []
    for field in range(packed.correct(lens, classifier, seeds[0]).shape[1]):
        inner = _without(packed, field)
        differences.append(_accuracy(lens, classifier, inner, seeds) - _accuracy(baseline, classifier, inner, seeds))
    return {"lowest": min(differences), "highest": max(differences)}


def draw(table: pandas.DataFrame, path: Path) -> None:
    """Draw the difference of each step as a point with its interval: filled for all fields, open for others."""
    table = table.drop_duplicates([key for key in _KEYS if key != "compared_with"])  # the first comparison of each step
    panels = list(table.groupby(["study", "elements", "classifier"], sort=False))
    columns = min(3, len(panels))
    count = math.ceil(len(panels) / columns)
    steps = list(STEPS)[1:]
    with matplotlib.rc_context({**vector_files.STYLE, "font.size": 9}):
        figure = Figure(figsize=(2.4 + 2.8 * columns, 0.6 + 2.4 * count), layout="constrained")
        axes = figure.subplots(count, columns, sharex=True, sharey=True, squeeze=False)
        for axis in axes.flat[len(panels) :]:
            axis.remove()
        for axis, ((study, elements, _), part) in zip(axes.flat, panels, strict=False):
            for row in part.dropna(subset="difference").to_dict("records"):
                inner = row["fields"] != _ALL
                y = steps.index(row["step"]) + 0.25 * inner
                axis.plot([row["low"], row["high"]], [y, y], color="#0072B2", linewidth=1 if inner else 2)
                face = "white" if inner else "#0072B2"
                axis.plot(row["difference"], y, "o", color="#0072B2", markerfacecolor=face, markersize=5)
                if not inner:
                    axis.text(1.01, y, f"{row['accuracy']:.1f}", transform=axis.get_yaxis_transform(), va="center")
            axis.axvline(0, color="black", linewidth=1)
            first = part.iloc[0]
            title = f"{study}\n{elements} ({first['step']} {first['accuracy']:.1f})"
            axis.set_title(title, fontsize="medium", loc="left")
            axis.spines[["top", "right"]].set_visible(False)
        for axis in axes.flat[len(panels) - columns : len(panels)]:  # the lowest of each column
            axis.tick_params(labelbottom=True)
        axes[0, 0].set_yticks(range(len(steps)), steps)
        axes[0, 0].set_ylim(len(steps) - 0.4, -0.6)
        axes[0, 0].set_xscale("symlog", linthresh=2)  # least squares is far behind, the last steps are small
        axes[0, 0].xaxis.set(major_formatter="{x:g}")
        label = (
            "accuracy minus that of the step above; for the task, minus that of the best image-quality lens [points]\n"
            "numbers: accuracy [%]; open symbols: at the paper's nine fields, or at nine without the corner"
        )
        figure.supxlabel(label, fontsize="medium")
        figure.savefig(path, format="svg", metadata=vector_files.METADATA["svg"])


def differs(study: str, table: pandas.DataFrame) -> bool:
    """Return whether the rows of a study in decomposition.csv are not these."""
    published = pandas.read_csv(FOLDER / "decomposition.csv")
    published = published[published["study"] == study].reset_index(drop=True)
    table = table.replace("", None).reindex(columns=published.columns)
    try:
        pandas.testing.assert_frame_equal(table, published, check_dtype=False, rtol=0, atol=1e-6)
    except AssertionError as error:
        print(f"{study}: {error}")
        return True
    return False


def main() -> int:
    """Write the table and the figure of the studies on the command line, or check their rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("studies", nargs="+", metavar="STUDY")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    tables = {study: rows(study) for study in options.studies}
    if options.check:
        return any([differs(study, table) for study, table in tables.items()])
    table = pandas.concat(tables.values())
    table.to_csv(FOLDER / "decomposition.csv", index=False)
    supervisors = table.groupby("study")["classifier"].transform("first")  # table 1 comes first
    table = table[table["classifier"] == supervisors]
    draw(table, FOLDER / "decomposition.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
