"""Ranking of lenses by the accuracy of a network on their captures: order, intervals, groups, and a page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy
import pandas
from scipy.stats import studentized_range

from tasklens.show import pictures, predictions
from tasklens.show.bootstrap import interval, resampled_means

SIGNIFICANCE = 0.05
_ROUNDING = 1e-9  # of accuracies [%]: resampled means of equal values differ in the last digits
_SCALE = 5.0  # step of the axis of accuracies on the page [%]


@dataclass(frozen=True)
class Rank:
    """One lens in a ranking; accuracies [%], differences [points].

    Attributes:
        group: number of the group, from 1.
        low, high: interval of the accuracy.
        behind, behind_low, behind_high: accuracy of the first lens minus this one, and its interval.
        by_field: accuracy at each field.
    """

    lens: str
    group: int
    accuracy: float
    low: float
    high: float
    behind: float
    behind_low: float
    behind_high: float
    by_field: tuple[float, ...]


def rank_lenses(correct: Mapping[str, pandas.DataFrame]) -> list[Rank]:
    """Rank lenses by accuracy, and group lenses that the photographs cannot tell apart.

    A group begins with the best lens that has no group yet. It ends before the first lens that is significantly less
    accurate: by the paired difference over its standard error, from resampled photographs, and the distribution of the
    studentised range (Tukey), since the best of several lenses was chosen on the same photographs.

    Args:
        correct: by lens, 1 where an image is classified correctly, else 0; a row per image, a column per field.
    """
    names = sorted(correct, key=lambda name: -correct[name].to_numpy().mean())
    for name in names[1:]:
        predictions.same_images(correct[names[0]], correct[name], f"{names[0]} and {name}")
    values = 100 * numpy.stack([correct[name].mean(axis=1).to_numpy() for name in names], 1)
    means, observed = resampled_means(values), values.mean(0)
    groups = _groups(means, len(values))
    ranks = []
    for k, name in enumerate(names):
        low, high = _interval(means[:, 0] - means[:, k], len(values)) if k else (0.0, 0.0)
        behind = max(low, -100.0), min(high, 100.0)
        by_field = tuple(predictions.accuracy_by_field(correct[name]))
        low, high = _interval(means[:, k], len(values))
        accuracy = observed[k], max(low, 0.0), min(high, 100.0)
        ranks.append(Rank(name, groups[k], *accuracy, observed[0] - observed[k], *behind, by_field))
    return ranks


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


def sentences(ranks: Sequence[Rank], titles: Mapping[str, str]) -> list[str]:
    """Say, group by group, which lenses are equal and how far the others are behind."""
    answer = []
    for number in range(1, ranks[-1].group + 1):
        group = [rank for rank in ranks if rank.group == number]
        names = _and([titles.get(rank.lens, rank.lens) for rank in group])
        if number > 1:
            low, high = min(rank.behind_low for rank in group), max(rank.behind_high for rank in group)
            answer.append(f"{names}: {low:.1f} to {high:.1f} points behind the first.")
        elif len(ranks) == 1:
            answer.append(f"{names}: {ranks[0].accuracy:.1f} %, without another lens to compare with.")
        elif len(group) == 1:
            answer.append(f"{names} is the best.")
        else:
            most = max(rank.behind_high for rank in group)
            answer.append(f"{names} cannot be distinguished by these photographs: they agree within {most:.1f} points.")
    return answer


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def row(
    rank: Rank, title: str, at_nine: pandas.DataFrame, f_number: float, field_of_view_deg: float, rms_spot_um: float
) -> dict[str, Any]:
    """Return the row of a lens in the table; `at_nine` are its answers at the paper's nine fields."""
    by_field = predictions.accuracy_by_field(at_nine)
    return {
        "lens": title,
        "group": rank.group,
        "accuracy": rank.accuracy,
        "accuracy_low": rank.low,
        "accuracy_high": rank.high,
        "behind": rank.behind,
        "behind_low": rank.behind_low,
        "behind_high": rank.behind_high,
        "accuracy_at_nine": float(numpy.mean(by_field)),
        "accuracy_axis": by_field[0],
        "accuracy_corner": by_field[-1],
        "f_number": f_number,
        "field_of_view_deg": field_of_view_deg,
        "rms_spot_um": rms_spot_um,
    }


def render(
    ranks: Sequence[Rank],
    rows: Sequence[Mapping[str, Any]],
    drawings: Mapping[str, str],
    answer: Sequence[str],
    **words: Any,
) -> str:
    """Return the page as HTML.

    Args:
        rows: rows of the table, in the order of `ranks`.
        drawings: cross-sections by lens, as SVG.
        answer: sentences.
        words: `title`; `images`, their number; `sharp`, the accuracy on them [%]; `tuned`, how the network got used to
            a lens; `left_out` with reasons by lens; `grade` of built lenses.
    """
    entries = [
        {"rank": rank, "row": row, "drawing": pictures.of_text(drawings[rank.lens], ".svg")}
        for rank, row in zip(ranks, rows, strict=True)
    ]
    better = ranks[: (len(ranks) + 1) // 2]  # the other lenses may be at the left edge
    low = min(100 - _SCALE, _SCALE * (min(rank.low for rank in better) // _SCALE))
    values = {"entries": entries, "answer": answer, "low": low, "width": 100 - low}
    return pictures.render(__package__, "ranking.html", **values, **words)
