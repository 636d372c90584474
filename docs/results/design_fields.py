"""Draw what lenses see at the fields of their design and between them: `python docs/results/design_fields.py`.

The ablations `design_fields` and `design_fields_correlation` of the headline study design doublets by their loss at the
paper's nine fields, and over the whole sensor. The program reads their published answers, and writes design_fields.csv,
a row per lens and field (accuracies are means over seeds), and design_fields.svg.
"""

from pathlib import Path

import matplotlib
import pandas
from matplotlib.figure import Figure

from tasklens.fields import GRADING_CENTRES, PAPER
from tasklens.settings.field_settings import radii
from tasklens.show import vector_files
from tasklens.study import loading
from tasklens.study.report import answers_file

FOLDER = Path(__file__).parent
ABLATIONS = {"design_fields": "task, from flat plates", "design_fields_correlation": "image correlation"}
SETS = {"between": GRADING_CENTRES, "nine": PAPER}


def rows(name: str) -> pandas.DataFrame:
    """Return the accuracy [%] of the lenses of an ablation at each field, by its radius in units of the corner's."""
    aspect = loading.load(FOLDER.parents[1] / "config/headline.yaml").spec.aspect
    _, packed = answers_file.read(FOLDER / "whole_sensor" / f"ablation_{name}.npz")
    table = []
    for lens in dict.fromkeys(lens for lens, _, _ in packed.answers if lens.startswith("doublet-")):
        keys = [key for key in packed.answers if key.lens == lens]
        for fields, answers in (("between", packed.answers), ("nine", packed.at_nine)):
            accuracies = 100 * pandas.DataFrame([answers[key].mean() for key in keys]).mean()
            for radius, accuracy in zip(radii(SETS[fields], aspect), accuracies, strict=True):
                table.append((name, lens, fields, radius, accuracy, len(keys)))
    return pandas.DataFrame(table, columns=["ablation", "lens", "fields", "radius", "accuracy", "seeds"])


def draw(table: pandas.DataFrame, path: Path) -> None:
    """Draw accuracy over radius: a panel per ablation, a curve per lens, and the nine fields as dots."""
    with matplotlib.rc_context({**vector_files.STYLE, "font.size": 9}):
        figure = Figure(figsize=(8, 2.8), layout="constrained")
        for axes, (name, part) in zip(figure.subplots(1, 2, sharey=True), table.groupby("ablation"), strict=True):
            for radius in {*part.loc[part["fields"] == "nine", "radius"].round(4)}:
                axes.axvline(radius, color="grey", linewidth=0.7, linestyle=":")
            for lens, of_lens in part.groupby("lens"):
                at_nine = str(lens).endswith("_nine")
                label, colour = ("the nine fields", "#D55E00") if at_nine else ("the whole sensor", "#0072B2")
                curve, dots = of_lens.sort_values("radius"), of_lens[of_lens["fields"] == "nine"]
                axes.plot(curve["radius"], curve["accuracy"], color=colour, linewidth=1.2, label=label)
                axes.plot(dots["radius"], dots["accuracy"], "o", color=colour, markersize=4)
            axes.set_title(ABLATIONS[str(name)], fontsize="medium", loc="left")
            axes.set(xlim=(0, 1.02), xlabel="distance from the axis [of the corner]")
            axes.spines[["top", "right"]].set_visible(False)
        figure.axes[0].set_ylabel("accuracy [%]")
        figure.axes[0].legend(title="loss at", frameon=False)
        figure.savefig(path, format="svg", metadata=vector_files.METADATA["svg"])


if __name__ == "__main__":
    rows_of_all = pandas.concat([rows(name) for name in ABLATIONS])
    rows_of_all.to_csv(FOLDER / "design_fields.csv", index=False)
    draw(rows_of_all, FOLDER / "design_fields.svg")
