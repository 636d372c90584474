"""Effort of each design: lens evaluations, and the wall time of its job, as Snakemake measured it."""

from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.runtime import benchmarks as benchmark_files
from tasklens.show.publish import publish
from tasklens.study.effort import Efforts

_NOTE = """\
Study `{study}`. Lens evaluations are the steps of descents, or the evaluations of least squares, which are fewer if it
ends at a given spot. Time is the wall time of the design job, with the figures and PSFs of its lens, and any wait for a
GPU: the median of all seeds. A job that was interrupted counts from its last start. "In all" adds the designs of all
lenses from which the start was chosen, without the fine-tunings that this choice needed."""


def wall_minutes(path: Path) -> float:
    """Return the duration [min] from one of Snakemake's benchmark files; NaN if it has none.

    The duration is the wall time: Snakemake samples processor time every half minute and misses the last interval.
    """
    benchmark = benchmark_files.read(path)
    return float("nan") if benchmark is None else benchmark.seconds / 60


def collect(efforts: Efforts, benchmarks: Sequence[Path]) -> pandas.DataFrame:
    """Return a row per lens: evaluations and median wall time [min], alone and with all lenses it was chosen from.

    Args:
        benchmarks: benchmark files of the designs in `efforts.lens_keys`.
    """
    by_job = pandas.Series(list(map(wall_minutes, benchmarks)), [lens for lens, _ in efforts.lens_keys], dtype=float)
    minutes = by_job.groupby(level=0, sort=False).median()
    rows = []
    for lens in efforts.lenses:
        elements, _, design = lens.partition("-")
        lenses = [lens, *efforts.chosen_from[lens]]
        rows.append(
            {
                "elements": elements,
                "design": design,
                "evaluations": efforts.tried[lens],
                "wall_minutes": minutes[lens],
                "evaluations_in_all": sum(efforts.tried[other] for other in lenses),
                "wall_minutes_in_all": sum(minutes[other] for other in lenses),
            }
        )
    return pandas.DataFrame(rows)


def make(settings: Efforts, lenses: Sequence[Path], benchmarks: Sequence[Path], csv: Path, md: Path) -> None:
    """Write the efforts as CSV and Markdown; `lenses` only make Snakemake wait for the designs."""
    rows = collect(settings, benchmarks)
    publish(csv, md, rows, _NOTE.format(study=settings.study))
