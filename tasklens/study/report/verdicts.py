"""Verdicts on the claims of the paper for the lenses of a study, from differences and their intervals.

The difference is in points of accuracy, mean over fields, images and seeds, paired by seed and by image. Its 95 %
interval is from 10 000 resamples of the test images, and of the seeds if there are several. A claim has a margin: zero
for "more accurate", stated beforehand for "at least as accurate" (non-inferiority). It

    holds           if the difference is above minus the margin,
    does not hold   if it is below,

each significantly at 5 % after Holm's correction for all lenses and classifiers of the same claim and table. With fewer
than five seeds the verdict only suggests the difference. Otherwise the claim is undecided, and the reason gives the
largest difference that the interval allows.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy
import pandas

from tasklens.settings.names import SHARP
from tasklens.show import between_fields, bootstrap, predictions
from tasklens.show.publish import publish
from tasklens.study.claims import Claim, Claims
from tasklens.study.report import answers_file
from tasklens.study.report.measurements import LEAST_ENERGY, MeasurementFiles, Measurements, least_accuracy

LEAST_SEEDS = 5  # with three, t(2) = 4.30 makes intervals too wide
HOLDS, FAILS, UNDECIDED, SUGGESTS = "holds", "does not hold", "undecided", "suggests"
COLUMNS = [
    *("table", "claim", "lens", "baseline", "classifier"),
    *("difference", "low", "high", "p_holm", "median", "above", "seeds", "verdict", "reason"),
]
AT_NINE = ["difference_at_nine", "low_at_nine", "high_at_nine"]  # further columns, if all were measured there

_NOTE = """\
Study `{study}`. Differences in points of accuracy with their 95 % intervals over test images{seeds}. A claim holds if
the difference is above zero{margin}, and does not hold if it is below, at 5 % significance after Holm's correction for
the rows of the same claim and table; otherwise it is undecided. Fewer than {least} seeds only suggest a difference. The
baseline of each seed is the one of its kind with the best minival accuracy; brackets count the seeds. For the claim
about failure, the difference is the distance to the rule of failure: half of the light inside the window, or half of
the accuracy above chance."""


def verdict(
    difference: float, low: float, high: float, p_holm: float, seeds: int, margin: float = 0.0, over: str = "images"
) -> tuple[str, str]:
    """Return the verdict on a difference, and its reason.

    Args:
        difference, low, high: the difference and its interval [points].
        p_holm: corrected p-value of a difference of minus the margin.
        seeds: number of seeds.
        margin: margin of the claim [points].
        over: name of the resampled units other than seeds.
    """
    above = low > -margin
    if p_holm >= 1 - bootstrap.CONFIDENCE or not (above or high < -margin):
        return UNDECIDED, f"at most {math.ceil(round(10 * max(-low, high), 6)) / 10:.1f} points either way"
    if seeds < LEAST_SEEDS:
        over += ", one seed" if seeds == 1 else f" and {seeds} seeds"
        return f"{SUGGESTS} {difference:+.1f} points ({low:.1f} to {high:.1f} over {over})", "fewer than five seeds"
    bound = f"-{margin:g} points" if margin else "zero"
    return (HOLDS, f"above {bound}") if above else (FAILS, f"below {bound}")


def accuracy_by_image(
    lenses: Mapping[int, str], classifier: str, measurements: Measurements, fields: str = "field"
) -> pandas.DataFrame:
    """Compute the accuracy [%] of each test image, mean over fields: a row per image, a column per seed.

    Args:
        lenses: names of lenses by seed.
        fields: name of the set of fields.

    Raises:
        FileError: the seeds have different images.
    """
    columns: dict[int, pandas.Series] = {}
    for seed, lens in lenses.items():
        columns[seed] = 100 * measurements.correct(lens, classifier, seed, fields).mean(axis=1)
        where = f"{lens} with {classifier}, seed {seed}"
        predictions.same_images(next(iter(columns.values())), columns[seed], where)
    return pandas.DataFrame(columns)


def advantage(
    claim: Claim, baselines: Mapping[int, str], measurements: Measurements, fields: str = "field"
) -> tuple[pandas.DataFrame, numpy.ndarray]:
    """Compute the advantage of a claim [points], and the lower bounds of its means over images.

    For a claim about two lenses, the advantage is the difference of their accuracies, without bound. For a claim that a
    design fails, it is half of the sum of sharp accuracy and chance, minus the accuracy; its bound is 50 % minus the
    energy in the PSF window.

    Args:
        baselines: strongest baseline by seed.
        fields: name of the set of fields.

    Returns:
        A row per image and a column per seed; and (S,) lower bounds of the means over images.

    Raises:
        FileError: the files have different images.
    """
    seeds = list(baselines)
    own = accuracy_by_image(dict.fromkeys(seeds, claim.lens), claim.classifier, measurements, fields)
    if not claim.baselines:  # a claim about failure
        sharp = accuracy_by_image(dict.fromkeys(seeds, SHARP), claim.reference, measurements)
        chance = measurements.values(SHARP, claim.reference, seeds[0])["chance"]
        inside = [measurements.lens_values(claim.lens, seed)["energy_in_window"] for seed in seeds]
        other, own, least = own, least_accuracy(sharp, chance), 100 * LEAST_ENERGY - 100 * numpy.array(inside)
    else:
        other = accuracy_by_image(baselines, claim.classifier, measurements, fields)
        least = numpy.full(len(seeds), -numpy.inf)
    predictions.same_images(own, other, f"{claim.lens} and {baselines[seeds[0]] or SHARP}")
    return own - other, least


def collect(claims: Claims, measurements: Measurements) -> pandas.DataFrame:
    """Return a row per claim, with the columns `COLUMNS`, and `AT_NINE` if all lenses were measured there."""
    baselines = [
        {seed: measurements.strongest_baseline(claim, seed) for seed in claims.seeds} for claim in claims.claims
    ]
    advantages = [advantage(*pair, measurements) for pair in zip(claims.claims, baselines, strict=True)]
    if not advantages:
        return pandas.DataFrame(columns=COLUMNS)
    for claim, (frame, _) in zip(claims.claims, advantages, strict=True):
        predictions.same_images(advantages[0][0], frame, f"{claim.lens} with {claim.classifier}")
    values = numpy.stack([frame.to_numpy() for frame, _ in advantages])  # claim, image, seed
    count, images, seeds = values.shape
    resampled = bootstrap.resampled_means(values.transpose(1, 0, 2).reshape(images, count * seeds))
    rows = []
    for k, (claim, baseline) in enumerate(zip(claims.claims, baselines, strict=True)):
        least = advantages[k][1]
        observed = numpy.maximum(values[k].mean(0), least)
        by_seed = numpy.maximum(resampled[:, k * seeds : (k + 1) * seeds], least)
        means = bootstrap.resampled_over_seeds(by_seed, observed)
        keys = (claim.table, claim.text, claim.lens, _baseline_text(baseline.values()), claim.classifier)
        difference = float(observed.mean())
        p_value = bootstrap.p_value(means, seeds, -claim.margin)
        by_sign = (float(numpy.median(observed)), int((observed > -claim.margin).sum()))
        rows.append((*keys, difference, *bootstrap.interval(means), p_value, *by_sign, seeds, "", ""))
    table = pandas.DataFrame(rows, columns=COLUMNS)
    table["p_holm"] = table.groupby(["table", "claim"])["p_holm"].transform(
        lambda family: bootstrap.holm(family.tolist())
    )
    numbers = zip(*(table[c].tolist() for c in ("difference", "low", "high", "p_holm")), claims.claims, strict=True)
    table[["verdict", "reason"]] = [verdict(d, low, high, p, seeds, claim.margin) for d, low, high, p, claim in numbers]
    captured = [key for key in claims.measured_keys if key.lens != SHARP]
    if measurements.has("nine", captured):
        pairs = zip(claims.claims, baselines, strict=True)
        table[AT_NINE] = [_at_nine(claim, baseline, measurements) for claim, baseline in pairs]
    return table


def _at_nine(claim: Claim, baselines: Mapping[int, str], measurements: Measurements) -> tuple[float, float, float]:
    """Return the difference of a claim at the paper's nine fields [points], and its interval."""
    if not claim.baselines:
        return (math.nan,) * 3
    values = advantage(claim, baselines, measurements, "nine")[0].to_numpy()
    means = bootstrap.resampled_over_seeds(bootstrap.resampled_means(values), values.mean(0))
    return float(values.mean()), *bootstrap.interval(means)


def compare(
    lens: str, baselines: Sequence[str], classifier: str, seeds: Sequence[int], measurements: Measurements
) -> pandas.Series:
    """Return the row of `collect` for one lens and its baselines, without correction for other comparisons."""
    claim = Claim(table="", text="", lens=lens, baselines=tuple(baselines), classifier=classifier, reference=classifier)
    return collect(Claims(study="", claims=(claim,), seeds=tuple(seeds)), measurements).iloc[0]


def _baseline_text(baselines: Iterable[str]) -> str:
    """Name the baseline of all seeds, or each baseline with its number of seeds, most frequent first."""
    counts = Counter(baselines)
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{name} ({count})" for name, count in counts.most_common())


def fitted_lenses(claims: Claims, measurements: Measurements) -> list[str]:
    """Return a paragraph for each lens that is more accurate at the fields of its design than between them.

    For a lens whose design has none, or is unknown, they are the nine of the paper, if it is graded there.
    """
    paragraphs = []
    for key in claims.measured_keys:
        name = f"{key.lens}, {key.measured_name}, seed {key.seed}"
        if "accuracy_at_design_fields" in measurements.values(*key):
            words, fields = "the fields of its design", "design" if measurements.has("design", [key]) else "nine"
        elif measurements.has("nine", [key]):
            words, fields = "the paper's nine fields", "nine"
        else:
            continue
        between, at_fields = measurements.correct(*key), measurements.correct(*key, fields)
        paragraphs += [f"\n{line}" for line in between_fields.warnings({name: between}, {name: at_fields}, words)]
    return paragraphs


def seeds_phrase(claims: Claims) -> str:
    """Return " and seeds" if the intervals include the resampling of seeds."""
    return " and seeds" if len(claims.seeds) > 1 else ""


def make(settings: Claims, files: MeasurementFiles, csv: Path, md: Path, answers: Path) -> None:
    """Write the verdicts as CSV and Markdown, and the answers from which they can be recomputed."""
    measurements = Measurements.of(settings, files)
    rows = collect(settings, measurements)
    answers_file.write(answers, settings, measurements)
    margin = max((claim.margin for claim in settings.claims), default=0.0)
    words = f', for "at least as accurate" above -{margin:g} points' if margin else ""
    note = _NOTE.format(study=settings.study, seeds=seeds_phrase(settings), least=LEAST_SEEDS, margin=words)
    note = note if len(rows) else f"Study `{settings.study}` has no lenses that the paper's claims are about."
    note = "\n".join([note, *fitted_lenses(settings, measurements)])
    publish(csv, md, rows, note)
