"""Effort of each design: lenses tried, and the duration of its job on one core, as Snakemake measured it."""

from pathlib import Path

import pandas

from tasklens.report.publish import publish, rounded
from tasklens.runtime import benchmarks
from tasklens.runtime.files import Files
from tasklens.study.effort import Efforts
from tasklens.study.settings import Slice

_NOTE = """\
Study `{study}`. Lenses tried: steps of a descent, or the budget of evaluations of least squares. Minutes of the job on
one core, with the figures and PSFs of its lens; of the seed with the shortest, since other work on the machine prolongs
them; of the last run, where it was interrupted. `in_all`: with the designs of all lenses that it was chosen from, but
not the fine-tunings that told some of them apart."""


def core_minutes(path: Path) -> float:
    """Return the duration [min] in one of Snakemake's benchmark files; NaN where it has none.

    Its processor time is sampled every half minute, and misses the last part of that.
    """
    found = benchmarks.read(path)
    return float("nan") if found is None else found.seconds / 60


def collect(efforts: Efforts, benchmark: str) -> pandas.DataFrame:
    """Return a row per lens: lenses tried and least core-minutes, its own and with those it was chosen from.

    Args:
        benchmark: pattern of the benchmark files, with `{lens}` and `{seed}`.
    """
    minutes = {
        each.lens: pandas.Series(
            [core_minutes(Path(benchmark.format(lens=each.lens, seed=seed))) for seed in efforts.seeds]
        ).min()
        for each in efforts.efforts
    }
    rows = []
    for each in efforts.efforts:
        elements, _, design = each.lens.partition("-")
        used = (each.lens, *each.chosen_from)
        rows.append(
            {
                "elements": elements,
                "design": design,
                "lenses_tried": each.tried,
                "core_minutes": minutes[each.lens],
                "lenses_tried_in_all": each.tried_in_all,
                "core_minutes_in_all": sum(minutes[lens] for lens in used),
            }
        )
    return pandas.DataFrame(rows)


def make(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the efforts as CSV and Markdown."""
    rows = collect(settings.efforts, settings.benchmark)
    shown = rounded(rows, {"core_minutes": ".1f"})
    publish(outputs, "Effort of each design", rows, shown, _NOTE.format(study=settings.efforts.study))
