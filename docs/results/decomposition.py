"""Decompose the gain of task-driven design: `python docs/results/decomposition.py STUDY [STUDY ...]`.

From least squares to PSNR, to correlation, to correlation with a heavier corner, to the task: accuracy of each step and
its difference from the step before with a 95 % interval over seeds and images, with and without the corner field.
The program reads the published answers of studies (folders of docs/results), and writes decomposition.csv, of all
networks, and decomposition.svg, of the network that supervised the designs.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import pandas
from matplotlib.figure import Figure

from tasklens.report import answers_file, vector_files, verdicts
from tasklens.report.answers_file import PackedMeasurements
from tasklens.study.claims import Claim, Claims

FOLDER = Path(__file__).parent
STEPS = {  # designs of each step; of several, the one with the best minival accuracy in each seed
    "least squares": ("imaging2", "imaging3"),
    "PSNR": ("image_psnr",),
    "correlation": ("image_correlation",),
    "correlation, heavy corner": ("image_corner",),
    "task, from flat plates": ("tasklens",),
    "task, from quality": ("tasklens_from_quality",),
    "task, network trained jointly": ("tasklens_joint",),
}
_ALL, _WITHOUT = "all fields", "without the corner"


def rows(study: str) -> list[dict]:
    """Return a row for each elements, network, step and set of fields of a study."""
    claims, packed = answers_file.read(FOLDER / study / "verdicts.npz")
    inner = {key: frame.iloc[:, :-1] if frame.shape[1] > 1 else frame for key, frame in packed.answers.items()}
    by_fields = {_ALL: packed, _WITHOUT: replace(packed, answers=inner)}
    measured = dict.fromkeys((lens, name) for lens, name, _ in packed.answers if "-" in lens and "-" not in name)
    table = []
    for elements, classifier in dict.fromkeys((lens.partition("-")[0], name) for lens, name in measured):
        before: tuple[str, ...] = ()
        for step, designs in STEPS.items():
            lenses = tuple(lens for name in designs if (lens := f"{elements}-{name}", classifier) in measured)
            if not lenses:
                continue
            for fields, measurements in by_fields.items():
                row = {"study": study, "elements": elements, "classifier": classifier, "step": step, "fields": fields}
                row["accuracy"] = _accuracy(lenses, classifier, measurements, claims.seeds)
                if before:
                    row |= _difference(lenses[0], before, classifier, measurements, claims.seeds)
                table.append(row | {"seeds": len(claims.seeds)})
            before = lenses
    return table


def _accuracy(lenses: Sequence[str], classifier: str, packed: PackedMeasurements, seeds: Sequence[int]) -> float:
    """Return the accuracy [%], mean over seeds, of the best lens of each seed by minival accuracy."""
    values = []
    for seed in seeds:
        minival = {lens: packed.values(lens, classifier, seed)["minival_accuracy"] for lens in lenses}
        values.append(100 * packed.correct(max(lenses, key=minival.__getitem__), classifier, seed).to_numpy().mean())
    return sum(values) / len(values)


def _difference(
    lens: str, baselines: tuple[str, ...], classifier: str, packed: PackedMeasurements, seeds: tuple[int, ...]
) -> dict[str, float]:
    """Return the difference from the step before [points] with its interval."""
    claim = Claim(table="", text="", lens=lens, baselines=baselines, classifier=classifier, reference=classifier)
    frame = verdicts.collect(Claims(study="", claims=(claim,), seeds=seeds), packed)
    return {str(name): float(frame[name].iloc[0]) for name in ("difference", "low", "high", "median", "above")}


def draw(table: pandas.DataFrame, path: Path) -> None:
    """Draw the difference of each step as a point with its interval: filled for all fields, open without the corner."""
    panels = list(table.groupby(["study", "elements", "classifier"], sort=False))
    columns = min(3, len(panels))
    count = math.ceil(len(panels) / columns)
    steps = list(STEPS)[1:]
    with matplotlib.rc_context({**vector_files.STYLE, "font.size": 9}):
        figure = Figure(figsize=(2.4 + 2.8 * columns, 0.6 + 2.2 * count), layout="constrained")
        axes = figure.subplots(count, columns, sharex=True, sharey=True, squeeze=False)
        for axis in axes.flat[len(panels) :]:
            axis.remove()
        for axis, ((study, elements, _), part) in zip(axes.flat, panels, strict=False):
            for row in part.dropna(subset="difference").to_dict("records"):
                inner = row["fields"] == _WITHOUT
                y = steps.index(row["step"]) + 0.25 * inner
                axis.plot([row["low"], row["high"]], [y, y], color="#0072B2", linewidth=1 if inner else 2)
                face = "white" if inner else "#0072B2"
                axis.plot(row["difference"], y, "o", color="#0072B2", markerfacecolor=face, markersize=5)
                if not inner:
                    axis.text(1.01, y, f"{row['accuracy']:.1f}", transform=axis.get_yaxis_transform(), va="center")
            axis.axvline(0, color="black", linewidth=1)
            first = part.iloc[0]
            title = f"{study}: {elements} ({first['step']} {first['accuracy']:.1f})"
            axis.set_title(title, fontsize="medium", loc="left")
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, 0].set_yticks(range(len(steps)), steps)
        axes[0, 0].set_ylim(len(steps) - 0.4, -0.6)
        axes[0, 0].set_xscale("symlog", linthresh=2)  # least squares is far behind, the last steps are small
        axes[0, 0].xaxis.set(major_formatter="{x:g}")
        label = "accuracy minus that of the step above [points]; open: without the corner; numbers: accuracy [%]"
        figure.supxlabel(label, fontsize="medium")
        figure.savefig(path, format="svg", metadata=vector_files.METADATA["svg"])


def main(studies: Sequence[str]) -> int:
    """Write the table and the figure of these studies."""
    if not studies:
        print((__doc__ or "").splitlines()[0])
        return 2
    table = pandas.DataFrame([row for study in studies for row in rows(study)])
    table.to_csv(FOLDER / "decomposition.csv", index=False)
    supervisors = table.groupby("study")["classifier"].transform("first")  # table 1 comes first
    draw(table[table["classifier"] == supervisors], FOLDER / "decomposition.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
