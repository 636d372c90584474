"""Ranking of lenses by the accuracy of a network on their captures: order, intervals, groups, and a page."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy
import pandas
from scipy.stats import studentized_range

from tasklens.show import pictures, predictions
from tasklens.show.bootstrap import interval, resampled_means

SIGNIFICANCE = 0.05
_ROUNDING = 1e-9  # of accuracies [%]: resampled means of equal values differ in the last digits
_SCALE = 5.0  # step of the axis of accuracies on the page [%]


def rank_lenses(correct: Mapping[str, pandas.DataFrame], at_nine: Mapping[str, pandas.DataFrame]) -> pandas.DataFrame:
    """Rank lenses by accuracy, and group lenses that the photographs cannot tell apart.

    A group begins with the best lens that has no group yet. It ends before the first lens that is significantly less
    accurate: by the paired difference over its standard error, from resampled photographs, and the distribution of the
    studentised range (Tukey), since the best of several lenses was chosen on the same photographs.

    Args:
        correct: by lens, 1 where an image is classified correctly, else 0; a row per image, a column per field.
        at_nine: the same at the paper's nine fields, of all lenses or none.

    Returns:
        A row per lens, in order: `lens`; the number of its `group`, from 1; `accuracy` [%]; `behind`, the accuracy of
        the first lens minus this one [points]; both with their intervals, `_low` and `_high`; perhaps
        `accuracy_at_nine`, `accuracy_axis` and `accuracy_corner`, at the nine fields, the first and the last of them
        [%].
    """
    names = sorted(correct, key=lambda name: -correct[name].to_numpy().mean())
    for name in names[1:]:
        predictions.same_images(correct[names[0]], correct[name], f"{names[0]} and {name}")
    values = 100 * numpy.stack([correct[name].mean(axis=1).to_numpy() for name in names], 1)
    means, observed = resampled_means(values), values.mean(0)
    groups = _groups(means, len(values))
    rows = []
    for k, name in enumerate(names):
        low, high = _interval(means[:, k], len(values))
        behind_low, behind_high = _interval(means[:, 0] - means[:, k], len(values)) if k else (0.0, 0.0)
        row = {
            "lens": name,
            "group": groups[k],
            "accuracy": observed[k],
            "accuracy_low": max(low, 0.0),
            "accuracy_high": min(high, 100.0),
            "behind": observed[0] - observed[k],
            "behind_low": max(behind_low, -100.0),
            "behind_high": min(behind_high, 100.0),
        }
        if at_nine:
            axis, *others, corner = predictions.accuracy_by_field(at_nine[name])
            row |= {"accuracy_at_nine": numpy.mean([axis, *others, corner])}
            row |= {"accuracy_axis": axis, "accuracy_corner": corner}
        rows.append(row)
    return pandas.DataFrame(rows)


def _interval(means: numpy.ndarray, images: int) -> tuple[float, float]:
    """Return the interval of an accuracy or a difference [%] from resampled means.

    If all photographs agree, they show only that less than 1 - 0.025^(1 / images) of others differ.
    """
    if numpy.ptp(means) > _ROUNDING:
        return interval(means)
    return float(means[0] - _largest_undetected(images)), float(means[0] + _largest_undetected(images))


def _largest_undetected(images: int) -> float:
    """Return the largest percentage of photographs that may differ from some that all agree, at 97.5 %."""
    return 100 * (1 - 0.025 ** (1 / images))


def _groups(means: numpy.ndarray, images: int) -> list[int]:
    """Return the group of each lens from resampled means (R, L) in the order of the accuracies."""
    groups: list[int] = []
    while len(groups) < means.shape[1]:
        first = len(groups)
        behind = means[:, first, None] - means[:, first + 1 :]
        lenses = behind.shape[1] + 1
        end = means.shape[1]
        if lenses > 1:
            least = studentized_range.isf(SIGNIFICANCE, lenses, math.inf) / math.sqrt(2)
            spread = behind.std(0)
            detectable = numpy.where(spread > _ROUNDING, least * spread, _largest_undetected(images))
            less = (behind.mean(0) > detectable).nonzero()[0]
            end = first + 1 + less[0] if len(less) else end
        groups += [groups[-1] + 1 if groups else 1] * (end - first)
    return groups


def sentences(table: pandas.DataFrame) -> list[str]:
    """Say, group by group, which lenses are equal and how far the others are behind."""
    answer = []
    for number, group in table.groupby("group"):
        *others, last = group["lens"]
        names = f"{', '.join(others)} and {last}" if others else last
        low, high = group["behind_low"].min(), group["behind_high"].max()
        if number != 1:
            answer.append(f"{names}: {low:.1f} to {high:.1f} points behind the first.")
        elif len(table) == 1:
            accuracy = group["accuracy"].iloc[0]
            answer.append(f"{names}: {accuracy:.1f} %, without another lens to compare with.")
        elif not others:
            answer.append(f"{names} is the best.")
        else:
            answer.append(f"{names} cannot be distinguished by these photographs: they agree within {high:.1f} points.")
    return answer


def render(
    table: pandas.DataFrame,
    titles: Mapping[str, str],
    correct: Mapping[str, pandas.DataFrame],
    drawings: Mapping[str, str],
    answer: Sequence[str],
    **words: Any,
) -> str:
    """Return the page as HTML.

    Args:
        table: as `rank_lenses` returns it, with `f_number`, `field_of_view_deg` and `rms_spot_um`; perhaps with more.
        titles: by lens, if they differ from its name.
        correct: by lens, as in `rank_lenses`.
        drawings: cross-sections by lens, as SVG.
        answer: sentences.
        words: `title`; `images`, their number; `sharp`, the accuracy on them [%]; `tuned`, how the network got used to
            a lens; `left_out` with reasons by lens; `grade` of built lenses.
    """
    entries = [
        {
            "row": row.dropna().to_dict(),
            "title": titles.get(row["lens"], row["lens"]),
            "by_field": predictions.accuracy_by_field(correct[row["lens"]]),
            "drawing": pictures.of_text(drawings[row["lens"]], ".svg"),
        }
        for _, row in table.iterrows()
    ]
    better = table["accuracy_low"].head((len(table) + 1) // 2)  # the other lenses may be at the left edge
    low = min(100 - _SCALE, _SCALE * (better.min() // _SCALE))
    values = {"entries": entries, "answer": answer, "low": low, "width": 100 - low}
    return pictures.render(__package__, "ranking.html", **values, **words)
