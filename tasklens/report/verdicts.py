"""Whether the claims of the paper hold for the lenses of a study: differences, their intervals, and verdicts by rule.

The difference is in points of accuracy, mean over fields, pictures and seeds, paired by seed and by picture. Its 95 %
interval comes from 10 000 resamples of the test pictures, and of the seeds where several ran. A claim

    holds           where the whole interval is above zero,
    does not hold   where the whole interval is below zero,
    undecided       else; and, whatever the interval, where fewer than five seeds ran.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy
import pandas

from tasklens.pipeline.layout import SHARP, Layout
from tasklens.report import bootstrap
from tasklens.report import predictions as pictures
from tasklens.report.tables import lens_values, measured_values
from tasklens.runtime.files import write_text
from tasklens.study.claims import FLAT_FAILS, Claim, VerdictsJob

LEAST_SEEDS = 5  # three decide nothing: t(2) = 4.30
HOLDS, FAILS, UNDECIDED = "holds", "does not hold", "undecided"
COLUMNS = [
    *("table", "claim", "lens", "opponent", "classifier"),
    *("difference", "low", "high", "seeds", "verdict", "reason"),
]

_NOTE = """\
Study `{study}`. Differences in points of accuracy with their 95 % interval, over test pictures{seeds}. A claim holds
where the whole interval is above zero, does not hold where it is below, and is undecided else, or with fewer than
{least} seeds. The opponent of each seed is the best of its kind by minival accuracy (in brackets: in how many seeds).
For the claim about convergence, the difference is how far the rule of table 3 is missed: half of the light in the
window, half of the accuracy above chance."""


def verdict(low: float, high: float, seeds: int) -> tuple[str, str]:
    """Verdict on a difference with the interval `low` to `high` over `seeds` seeds, and its reason."""
    if seeds < LEAST_SEEDS:
        return UNDECIDED, "fewer than five seeds"
    if low > 0:
        return HOLDS, "interval above zero"
    if high < 0:
        return FAILS, "interval below zero"
    return UNDECIDED, "interval holds zero"


def opponent(claim: Claim, seed: int, layout: Layout) -> str:
    """The rival with the best minival accuracy with the claim's classifier and this seed; "" without rivals.

    Of each seed anew: whoever has two designs at hand keeps the better one.
    """

    def minival(rival: str) -> float:
        return measured_values(Path(layout.metrics(rival, seed, claim.classifier)))["minival_accuracy"]

    return max(claim.rivals, key=minival, default="")


def by_picture(lenses: Mapping[int, str], classifier: str, layout: Layout) -> pandas.DataFrame:
    """Accuracy [%] of each test picture, mean over fields: a row per picture, a column per seed.

    Args:
        lenses: by seed.

    Raises:
        FileError: the seeds have different pictures.
    """
    columns = {}
    for seed, lens in lenses.items():
        path = layout.pictures(lens, seed, classifier)
        columns[seed] = 100 * pictures.read(path).mean(axis=1)
        pictures.same_pictures(next(iter(columns.values())), columns[seed], path)
    return pandas.DataFrame(columns)


def advantage(claim: Claim, rivals: Mapping[int, str], layout: Layout) -> tuple[pandas.DataFrame, numpy.ndarray]:
    """What speaks for a claim [points], and the least that its mean over pictures counts for.

    For a claim about two lenses, the difference of their accuracies; it counts as it is. For convergence, what the
    accuracy lacks of half-way from chance to that of sharp pictures; and where the PSF window lacks more of half of the
    light, that counts instead.

    Args:
        rivals: the opponent of each seed.

    Returns:
        A row per picture and a column per seed; and (S,) least values of the means.
    """
    seeds = list(rivals)
    own = by_picture(dict.fromkeys(seeds, claim.lens), claim.classifier, layout)
    if claim.text == FLAT_FAILS:
        sharp = by_picture(dict.fromkeys(seeds, SHARP), claim.reference, layout)
        chance = measured_values(Path(layout.metrics(SHARP, seeds[0], claim.reference)))["chance"]
        inside = [lens_values(Path(layout.lens(claim.lens, seed)))["energy_in_window"] for seed in seeds]
        other, own, least = own, (sharp + chance) / 2, 50 - 100 * numpy.array(inside)
    else:
        other, least = by_picture(rivals, claim.classifier, layout), numpy.full(len(seeds), -numpy.inf)
    pictures.same_pictures(own, other, f"{claim.lens} and {rivals[seeds[0]] or SHARP}")
    return own - other, least


def collect(job: VerdictsJob, layout: Layout) -> pandas.DataFrame:
    """A row per claim, with the columns `COLUMNS`.

    Raises:
        FileNotFoundError: a measurement is missing.
    """
    rivals = [{seed: opponent(claim, seed, layout) for seed in job.seeds} for claim in job.claims]
    found = [advantage(*pair, layout) for pair in zip(job.claims, rivals, strict=True)]
    if not found:
        return pandas.DataFrame(columns=COLUMNS)
    for claim, (frame, _) in zip(job.claims, found, strict=True):
        pictures.same_pictures(found[0][0], frame, f"{claim.lens} with {claim.classifier}")
    values = numpy.stack([frame.to_numpy() for frame, _ in found])  # claim, picture, seed
    claims, count, seeds = values.shape
    resampled = bootstrap.resampled_means(values.transpose(1, 0, 2).reshape(count, claims * seeds))
    rows = []
    for k, (claim, rival) in enumerate(zip(job.claims, rivals, strict=True)):
        least = found[k][1]
        low, high = bootstrap.interval(numpy.maximum(resampled[:, k * seeds : (k + 1) * seeds], least))
        difference = float(numpy.maximum(values[k].mean(0), least).mean())
        judged = verdict(low, high, seeds)
        keys = (claim.table, claim.text, claim.lens, _named(rival.values()), claim.classifier)
        rows.append((*keys, difference, low, high, seeds, *judged))
    return pandas.DataFrame(rows, columns=COLUMNS)


def _named(opponents: Iterable[str]) -> str:
    """The opponent of all seeds; or each, the most frequent first, with the number of its seeds."""
    counts = Counter(opponents)
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{name} ({count})" for name, count in counts.most_common())


def make(job: VerdictsJob, layout: Layout, study: str) -> None:
    """Write the verdicts as CSV and Markdown."""
    rows = collect(job, layout)
    write_text(Path(layout.table("verdicts", "csv")), rows.to_csv(index=False))
    shown = rows.assign(**{name: rows[name].map("{:+.2f}".format) for name in ("difference", "low", "high")})
    table = shown.replace("", "–").to_markdown(index=False, disable_numparse=True)
    note = _NOTE.format(study=study, seeds=" and seeds" if len(job.seeds) > 1 else "", least=LEAST_SEEDS)
    text = f"{table}\n\n{note}" if len(rows) else f"Study `{study}` has no lenses that the paper's claims are about."
    write_text(Path(layout.table("verdicts", "md")), f"**Verdicts on the paper's claims**\n\n{text}\n")
