"""Table of tasks other than classification: scores of their networks through each lens, and PSFs of the lenses."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas

from tasklens.runtime.files import read_table
from tasklens.show import figures
from tasklens.show.panel import Panel
from tasklens.show.publish import publish
from tasklens.study.task_jobs import TaskContents, TaskKey

_NOTE = """\
Study `{study}`. Scores [%] on test images with objects, means over fields and seeds. `miou`: mean intersection over
union of classes and background. `box_ap` and `mask_ap`: COCO's average precision over IoU of 0.5 to 0.95; `ap50`: at
0.5. Frozen: the network that was trained on sharp images. Tuned: after fine-tuning on the captures of the lens. Sharp
images come first."""


def collect(metrics: Mapping[TaskKey, Path]) -> pandas.DataFrame:
    """Return a row per task, score and lens: means over fields and seeds, the worst field, and the number of seeds.

    Args:
        metrics: files of scores.
    """
    frames = [read_table(path, keep_default_na=False).assign(lens=key.lens) for key, path in metrics.items()]
    table = pandas.concat(frames, ignore_index=True)
    rows = []
    for (task, metric, _), scores in table.groupby(["task", "metric", "lens"], sort=False):
        fields = scores.groupby(["tuned", "field"])["value"].mean()
        rows.append(
            {
                "task": task,
                "score": metric,
                "elements": scores["elements"].iloc[0],
                "design": scores["design"].iloc[0],
                "frozen": fields[False].mean(),
                "tuned": fields[True].mean(),
                "worst_field": fields[True].min(),
                "seeds": scores["seed"].nunique(),
            }
        )
    order = {name: k for k, name in enumerate(table["task"].unique())}
    return pandas.DataFrame(rows).sort_values("task", key=lambda names: names.map(order), kind="stable")


def make(
    settings: TaskContents,
    metrics: Sequence[Path],
    lenses: Sequence[Path],
    psfs: Sequence[Path],
    csv: Path,
    md: Path,
    figure: Path,
) -> None:
    """Write the table as CSV and Markdown, and draw the PSFs of the lenses of the first seed one above the other.

    Args:
        metrics: scores of `settings.score_keys`.
        lenses, psfs: files of `settings.drawn`.
    """
    rows = collect(dict(zip(settings.score_keys, metrics, strict=True)))
    publish(csv, md, rows, _NOTE.format(study=settings.study))
    panels = [Panel.read(*arguments) for arguments in zip(settings.drawn, lenses, psfs, strict=True)]
    figures.compare_psfs(figure, panels)
