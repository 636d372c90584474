"""Table of built lenses: accuracy that each design loses in manufacture, task-driven designs against baselines."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy
import pandas

from tasklens.runtime.files import read_table, write_text
from tasklens.show import headings
from tasklens.show.bootstrap import holm, interval, p_value, resampled_means, resampled_over_seeds
from tasklens.show.publish import markdown, publish
from tasklens.show.tolerance_page import distribution
from tasklens.study.built_lenses import BuiltContents
from tasklens.study.report.verdicts import FAILS, HOLDS, verdict
from tasklens.study.table_contents import LensKey

_NOTE = """\
Study `{study}`, {grade}: {built} built lenses of each design and seed, focused by their MTF and measured by the
classifier of the design on the same test images (at most {images}) over the sensor. RMS spot and MTF at a quarter of
the Nyquist frequency are medians. A failed lens lets no light through to some field."""

_QUESTION = """\
**Do task-driven lenses tolerate more?** The accuracy that a task-driven lens loses in manufacture minus what its
baseline loses, with the 95 % interval over built lenses{over}; negative if the task-driven lens tolerates more.
Designs with the same elements are built with the same errors. A difference is undecided if it is not significant at 5
% after Holm's correction for all rows; fewer than five seeds only suggest it. Test images are the same for all and
not resampled."""


# The claim is that a lens loses more than its baseline.
_ANSWERS = {HOLDS: "tolerates less", FAILS: "tolerates more"}


def collect(lenses: Mapping[LensKey, Path]) -> pandas.DataFrame:
    """Return a row per lens: `tolerance_page.distribution`, mean over seeds; sums of failures and of built lenses.

    Args:
        lenses: files of built lenses by (lens, seed).
    """
    distributions: dict[str, list[dict[str, float]]] = {}
    for (lens, _), path in lenses.items():
        distributions.setdefault(lens, []).append(distribution(read_table(path).to_dict("records")))
    table = []
    for lens, by_seed in distributions.items():
        frame = pandas.DataFrame(by_seed)
        total = frame[["failed_lenses", "built"]].sum().astype(int).to_dict()
        elements, _, design = lens.partition("-")
        table.append({"elements": elements, "design": design, **frame.mean().to_dict(), **total, "seeds": len(by_seed)})
    return pandas.DataFrame(table)


def compare(lenses: Mapping[LensKey, Path], pairs: Sequence[tuple[str, str]], seeds: Sequence[int]) -> pandas.DataFrame:
    """Compare the losses in manufacture of lenses with those of their baselines.

    Args:
        lenses: files of built lenses by (lens, seed).
        pairs: (lens, baseline).

    Returns:
        A row per pair: difference [points] with its interval, and the verdict with its reason.
    """
    rows = []
    for lens, baseline in pairs:
        by_seed = []
        for seed in seeds:
            losses = [_accuracy_losses(lenses[LensKey(name, seed)]) for name in (lens, baseline)]
            by_seed.append(losses[0] - losses[1])
        columns = numpy.stack(
            [resampled_means(values[:, None], seed=2 + k)[:, 0] for k, values in enumerate(by_seed)], 1
        )
        means = resampled_over_seeds(columns, numpy.array([values.mean() for values in by_seed]))
        low, high = interval(means)
        difference = float(numpy.mean([values.mean() for values in by_seed]))
        rows.append((lens, baseline, difference, low, high, p_value(means, len(seeds))))
    table = pandas.DataFrame(rows, columns=["lens", "baseline", "difference", "low", "high", "p_holm"])
    table["p_holm"] = holm(table["p_holm"].tolist())
    numbers = table[["difference", "low", "high", "p_holm"]].to_numpy(float).tolist()
    verdicts = [verdict(d, low, high, p, len(seeds), over="built lenses") for d, low, high, p in numbers]
    table["verdict"] = [_ANSWERS.get(answer, answer) for answer, _ in verdicts]
    table["reason"] = [reason for _, reason in verdicts]
    return table


def _accuracy_losses(path: Path) -> numpy.ndarray:
    """Return the accuracy that each built lens loses [points]."""
    accuracy = read_table(path)["accuracy"].to_numpy(float)
    return accuracy[0] - accuracy[1:]


def make(settings: BuiltContents, built_lenses: Sequence[Path], csv: Path, md: Path, compared_csv: Path) -> None:
    """Write the table and the comparison as CSV, and both as Markdown; `built_lenses` are the files of `lens_keys`."""
    lenses = dict(zip(settings.lens_keys, built_lenses, strict=True))
    rows = collect(lenses)
    comparison = compare(lenses, settings.pairs, settings.seeds)
    over = ", and over seeds" if len(settings.seeds) > 1 else ""
    note = _NOTE.format(
        study=settings.study, grade=settings.grade.replace("_", " "), built=settings.built, images=settings.images
    )
    if len(comparison):
        note += f"\n\n{_QUESTION.format(over=over)}\n\n{markdown(headings.texts(comparison))}"
    publish(csv, md, rows, note)
    write_text(compared_csv, comparison.to_csv(index=False))
