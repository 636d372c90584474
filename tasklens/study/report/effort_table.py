"""Effort of each design: lens evaluations, and the wall time of its job, as Snakemake measured it."""

from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.runtime import benchmarks as benchmark_files
from tasklens.show.publish import publish
from tasklens.study.effort import Efforts
from tasklens.study.table_contents import LensKey

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
    by_key = dict(zip(efforts.lens_keys, map(wall_minutes, benchmarks), strict=True))
    minutes = {
        effort.lens: pandas.Series([by_key[LensKey(effort.lens, seed)] for seed in efforts.seeds]).median()
        for effort in efforts.efforts
    }
    tried = {effort.lens: effort.tried for effort in efforts.efforts}
    rows = []
    for effort in efforts.efforts:
        elements, _, design = effort.lens.partition("-")
        all_lenses = (effort.lens, *effort.chosen_from)
        rows.append(
            {
                "elements": elements,
                "design": design,
                "evaluations": effort.tried,
                "wall_minutes": minutes[effort.lens],
                "evaluations_in_all": sum(tried[lens] for lens in all_lenses),
                "wall_minutes_in_all": sum(minutes[lens] for lens in all_lenses),
            }
        )
    return pandas.DataFrame(rows)


def make(settings: Efforts, lenses: Sequence[Path], benchmarks: Sequence[Path], csv: Path, md: Path) -> None:
    """Write the efforts as CSV and Markdown; `lenses` only make Snakemake wait for the designs."""
    rows = collect(settings, benchmarks)
    publish(csv, md, rows, _NOTE.format(study=settings.study))
