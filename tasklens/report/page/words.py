"""The answer of a study in sentences, derived by rules from its verdicts."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas

from tasklens.report.optimality import Optimum
from tasklens.report.verdicts import FAILS, HOLDS, LEAST_SEEDS, SUGGESTS

SHOWN, SUGGESTED, UNDECIDED = "shown", "suggested", "undecided"
FOR, AGAINST = "for", "against"


@dataclass(frozen=True)
class Sentence:
    """A sentence and its direction: FOR or AGAINST the task-driven lens, UNDECIDED, or "" for none."""

    text: str
    direction: str = ""


def judged(row: Mapping[Any, Any], margin: float) -> tuple[str, str]:
    """Return the direction of a verdict (for or against) and its certainty (shown or suggested); or UNDECIDED twice.

    Args:
        row: row of the table of verdicts.
        margin: points by which the lens may be less accurate, as the claim states beforehand.
    """
    if row["verdict"] == HOLDS:
        return FOR, SHOWN
    if row["verdict"] == FAILS:
        return AGAINST, SHOWN
    if str(row["verdict"]).startswith(SUGGESTS):
        return (FOR if row["low"] > -margin else AGAINST), SUGGESTED
    return UNDECIDED, UNDECIDED


def summary(verdicts: pandas.DataFrame, margins: Mapping[str, float], seeds: int) -> list[Sentence]:
    """Say how many claims hold, and how certain that is."""
    if verdicts.empty:
        return [Sentence("The paper's claims are about no lenses of this study.")]
    counts = Counter(judged(row, margins.get(row["claim"], 0.0)) for row in verdicts.to_dict("records"))
    words = {
        (FOR, SHOWN): ("holds", "hold"),
        (AGAINST, SHOWN): ("does not hold", "do not hold"),
        (FOR, SUGGESTED): ("is suggested to hold", "are suggested to hold"),
        (AGAINST, SUGGESTED): ("is suggested not to hold", "are suggested not to hold"),
        (UNDECIDED, UNDECIDED): ("is undecided", "are undecided"),
    }
    parts = [f"{counts[key]} {one if counts[key] == 1 else many}" for key, (one, many) in words.items() if counts[key]]
    claims = "1 claim" if len(verdicts) == 1 else f"{len(verdicts)} claims"
    sentences = [Sentence(f"Of {claims} tested here, {_listed(parts)}.")]
    if seeds < LEAST_SEEDS:
        number, over = ("is only one seed", "") if seeds == 1 else (f"are only {seeds} seeds", " and seeds")
        sentences.append(
            Sentence(
                f"There {number} of design, fine-tuning and order of the data: differences are suggested, not shown. "
                f"Their intervals of 95 % are over test images{over}; {LEAST_SEEDS} seeds are needed to show one."
            )
        )
    else:
        sentences.append(
            Sentence(f"Intervals of 95 % are over test images and {seeds} seeds; errors by Holm's correction.")
        )
    return sentences


def answers(
    verdicts: pandas.DataFrame, elements: Iterable[str], questions: Iterable[str], margins: Mapping[str, float]
) -> dict[str, list[Sentence]]:
    """Say, for each name of elements, whether its task-driven lenses in table 1 are better than the others.

    Args:
        questions: texts of claims; all of them are answered, in this order.
    """
    by_elements = {}
    for name in elements:
        claims = verdicts[(verdicts["table"] == "table1") & (verdicts["lens"].str.split("-").str[0] == name)]
        rows = [row for text in questions for row in claims[claims["claim"] == text].to_dict("records")]
        if rows:
            by_elements[name] = [comparison(row, margins.get(row["claim"], 0.0)) for row in rows]
    return by_elements


def comparison(row: Mapping[Any, Any], margin: float) -> Sentence:
    """Express the verdict on a lens and its baseline as a sentence."""
    direction, certainty = judged(row, margin)
    lens, baseline = row["lens"].partition("-")[2], row["baseline"]
    same = f"{row['lens'].partition('-')[0]}-"
    baseline = ", ".join(part.strip().removeprefix(same) for part in str(baseline).split(","))
    kind = row["claim"].removeprefix("more accurate than ")
    other = baseline if baseline == kind else f"{baseline}, {kind}"
    interval = f"{row['low']:+z.1f} to {row['high']:+z.1f}".replace("-", "−")
    if direction == UNDECIDED:
        return Sentence(f"Undecided: {lens} is {row['reason']} ({interval}) of {other}.", direction)
    points = abs(row["difference"])
    unit = "point" if f"{points:.1f}" == "1.0" else "points"
    more = "more" if row["difference"] > 0 else "less"
    label = {SHOWN: "Shown", SUGGESTED: "Suggested"}[certainty]
    return Sentence(f"{label}: {lens} is {points:.1f} {unit} {more} accurate ({interval}) than {other}.", direction)


def best_lenses(table1: pandas.DataFrame, task_driven: Iterable[str]) -> dict[str, Sentence]:
    """Name the most accurate task-driven lens and the most accurate other lens in table 1, by name of elements."""
    lenses = table1[table1["elements"].fillna("") != ""].dropna(subset=["accuracy"])
    by_task = (lenses["elements"] + "-" + lenses["design"]).isin(list(task_driven))
    sentences = {}
    for name in dict.fromkeys(lenses["elements"]):
        in_elements = lenses["elements"] == name
        parts = []
        for words, kind in (("designed by the task", in_elements & by_task), ("of the others", in_elements & ~by_task)):
            if kind.any():
                best = lenses.loc[lenses[kind]["accuracy"].idxmax()]
                parts.append(f"{best['accuracy']:.1f} % through {best['design']}, the best {words}")
        sentences[name] = Sentence(f"{'; '.join(parts)}.")
    return sentences


def convergence(optima: Mapping[str, Optimum]) -> list[Sentence]:
    """Say which designs are at a local optimum of their criterion, according to the test in their files."""
    optimal = [lens for lens, optimum in optima.items() if optimum.reached]
    sentences = []
    if optimal:
        text = (
            f"Converged: {_listed(optimal)}. No small step within the limits lowers the loss by more than two standard"
        )
        sentences.append(Sentence(f"{text} errors and 0.002.", FOR))
    for lens, optimum in optima.items():
        if not optimum.reached:
            text = f"Not converged: a step of {optimum.step_um:g} um within the limits lowers the loss of {lens} by"
            sentences.append(Sentence(f"{text} {optimum.gain:.4f} (standard error {optimum.error:.4f}).", AGAINST))
    return sentences


def _listed(parts: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))
