"""The answer of a study in sentences, derived by rules from its verdicts."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas

from tasklens.show.optimality import Optimum
from tasklens.study.claims import PaperClaim
from tasklens.study.report.verdicts import FAILS, HOLDS, LEAST_SEEDS, SUGGESTS
from tasklens.study.report_jobs import ReportJob

_LEARNT = 0.1  # share of the way from chance to 100 % that a network has to reach
SHOWN, SUGGESTED, UNDECIDED = "shown", "suggested", "undecided"
FOR, AGAINST = "for", "against"


@dataclass(frozen=True)
class Sentence:
    """A sentence and its direction: FOR or AGAINST the task-driven lens, UNDECIDED, or "" for none."""

    text: str
    direction: str = ""


def direction_and_certainty(row: Mapping[Any, Any], margin: float) -> tuple[str, str]:
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


def summary(verdicts: pandas.DataFrame, settings: ReportJob) -> list[Sentence]:
    """Answer the study in three sentences: the gain by elements, the paper's claims, and how certain this is."""
    if verdicts.empty:
        return [Sentence("The paper's claims are about no lenses of this study.")]
    counted = tallies(verdicts, settings.paper_claims, settings.margins)
    sentences, seeds = [_gains(verdicts, settings), _claims(counted)], len(settings.seeds)
    if seeds < LEAST_SEEDS:
        number, over = ("One seed", "") if seeds == 1 else (f"{seeds} seeds", " and seeds")
        text = f"{number} can only suggest a difference; at least {LEAST_SEEDS} are needed to show one."
        sentences.append(Sentence(f"{text} Intervals are 95 % over test images{over}."))
    else:
        text = f"Intervals are 95 % over test images and {seeds} seeds; p-values are corrected by Holm's method."
        sentences.append(Sentence(text))
    return [sentence for sentence in sentences if sentence is not None]


def _claims(counted: Iterable["Tally"]) -> Sentence | None:
    """Say how many of the paper's claims the comparisons support; None if none of them is tested."""
    words = {
        FOR: "supported by every comparison",
        UNDECIDED: "mixed or undecided",
        AGAINST: "contradicted by every comparison",
    }
    outcomes = Counter(tally.outcome for tally in counted if tally.of_the_paper)
    if outcomes.total() == 1:
        return Sentence(f"The one claim of the paper that is tested here is {words[next(iter(outcomes))]}.")
    parts = [f"{outcomes[key]} {'is' if outcomes[key] == 1 else 'are'} {words[key]}" for key in words if outcomes[key]]
    return Sentence(f"Of the paper's {outcomes.total()} claims tested here, {_join(parts)}.") if parts else None


def _gains(verdicts: pandas.DataFrame, settings: ReportJob) -> Sentence | None:
    """Give the gain of the first task-driven lens of each elements, by the first question that the study answers."""
    table1 = verdicts[verdicts["table"] == "table1"]
    for text in settings.questions:
        claims = table1[table1["claim"] == text].drop_duplicates("lens").set_index("lens")
        first: dict[str, str] = {}
        for lens in settings.by_task:
            if lens in claims.index:
                first.setdefault(settings.elements[lens], lens)
        parts = []
        for elements, lens in first.items():
            row = claims.loc[lens].to_dict()
            certainty = direction_and_certainty(row, settings.margins.get(text, 0.0))[1]
            design, baseline = (str(name).replace(f"{elements}-", "") for name in (lens, row["baseline"]))
            parts.append(f"{elements} {design} {_points(row)} compared with {baseline}, {certainty}")
        if parts:
            kind = text.removeprefix("more accurate than ")
            return Sentence(f"Accuracy compared with {kind} (chosen on minival images): {'; '.join(parts)}.")
    return None


def _points(row: Mapping[Any, Any]) -> str:
    """Format a difference with its interval."""
    unit = "point" if f"{abs(row['difference']):.1f}" == "1.0" else "points"
    low, high = (f"{row[end]:+z.1f}" for end in ("low", "high"))
    if "+0.0" in (low, high):  # the sign of a small bound decides
        low, high = (f"{row[end]:+z.2f}" for end in ("low", "high"))
    text = f"{row['difference']:+z.1f} {unit} ({low} to {high})"
    return text.replace("-", "−")


@dataclass(frozen=True)
class Tally:
    """A claim of the paper, with the number of comparisons for it, against it, and undecided."""

    sentence: str
    of_the_paper: bool
    directions: Counter[str]

    @property
    def outcome(self) -> str:
        """FOR or AGAINST if all comparisons agree, else UNDECIDED."""
        for direction in (FOR, AGAINST):
            if self.directions[direction] == self.directions.total():
                return direction
        return UNDECIDED


def tallies(verdicts: pandas.DataFrame, claims: Iterable[PaperClaim], margins: Mapping[str, float]) -> list[Tally]:
    """Count the comparisons for and against each claim."""
    counted = []
    for claim in claims:
        rows = verdicts[(verdicts["table"] == claim.table) & verdicts["claim"].isin(claim.texts)].to_dict("records")
        directions = Counter(direction_and_certainty(row, margins.get(row["claim"], 0.0))[0] for row in rows)
        if rows:
            counted.append(Tally(claim.sentence, claim.of_the_paper, directions))
    return counted


def chance(by_seed: Mapping[str, pandas.DataFrame]) -> list[Sentence]:
    """Warn about networks that are near chance on images without a lens, from the tables by seed."""
    sentences = []
    rows = pandas.concat(list(by_seed.values())).dropna(subset=["reference_accuracy"])
    means = rows.groupby("classifier", sort=False)[["reference_accuracy", "chance"]].mean()
    for classifier, accuracy, guessing in means.itertuples():
        if accuracy < guessing + _LEARNT * (100 - guessing):
            text = f"{classifier} recognises {accuracy:.1f} % of the sharp images; chance is {guessing:.1f} %"
            sentences.append(Sentence(f"Warning: {text}. Comparisons with it mean nothing.", AGAINST))
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
    direction, certainty = direction_and_certainty(row, margin)
    lens, baseline = row["lens"].partition("-")[2], row["baseline"]
    same = f"{row['lens'].partition('-')[0]}-"
    baseline = ", ".join(part.strip().removeprefix(same) for part in str(baseline).split(","))
    kind = row["claim"].removeprefix("more accurate than ")
    other = baseline if baseline == kind else f"{baseline}, {kind}"
    label = {SHOWN: "Shown", SUGGESTED: "Suggested", UNDECIDED: "Undecided"}[certainty]
    return Sentence(f"{label}: {lens} {_points(row)} compared with {other}.", direction)


def best_lenses(table1: pandas.DataFrame, task_driven: Iterable[str]) -> dict[str, Sentence]:
    """Name the most accurate task-driven lens and the most accurate other lens in table 1, by name of elements."""
    lenses = table1[table1["elements"] != ""].dropna(subset=["accuracy"])
    by_task = (lenses["elements"] + "-" + lenses["design"]).isin(list(task_driven))
    sentences = {}
    for name in dict.fromkeys(lenses["elements"]):
        in_elements = lenses["elements"] == name
        parts = []
        for words, kind in (("task-driven", in_elements & by_task), ("other", in_elements & ~by_task)):
            if kind.any():
                best = lenses.loc[lenses[kind]["accuracy"].idxmax()]
                parts.append(f"{best['design']}, the most accurate {words} design: {best['accuracy']:.1f} %")
        sentences[name] = Sentence(f"{'; '.join(parts)}.")
    return sentences


def convergence(optima: Mapping[str, Optimum]) -> list[Sentence]:
    """Say which designs are at a local optimum of their criterion, according to the test in their files."""
    optimal = [lens for lens, optimum in optima.items() if optimum.reached]
    sentences = []
    if optimal:
        text = "No small step within the limits lowers the loss by more than two standard errors plus 0.002"
        sentences.append(Sentence(f"Converged: {_join(optimal)}. {text}.", FOR))
    for lens, optimum in optima.items():
        if not optimum.reached:
            text = f"Not converged: a step of {optimum.step_um:g} um within the limits lowers the loss of {lens} by"
            sentences.append(Sentence(f"{text} {optimum.gain:.4f} (standard error {optimum.error:.4f}).", AGAINST))
    return sentences


def _join(parts: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))
