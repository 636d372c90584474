"""Figure of the task-driven lenses and the best imaging lens for one set of elements (the paper's figure 3)."""

from collections.abc import Sequence
from pathlib import Path

from tasklens.show import figures
from tasklens.show.panel import Panel
from tasklens.study.claims import Claims
from tasklens.study.report.measurements import Measurements


def run(
    settings: Claims,
    lenses: Sequence[Path],
    psfs: Sequence[Path],
    metrics: Sequence[Path],
    figure: Path,
    figure_svg: Path,
    figure_pdf: Path,
) -> None:
    """Draw the lens of each claim, and the strongest baseline of the claims.

    Args:
        lenses, psfs: files of the lenses in `settings.lenses`.
        metrics: measurements of `settings.baseline_keys`.
    """
    lens_of = dict(zip(settings.lenses, lenses, strict=True))
    psf_of = dict(zip(settings.lenses, psfs, strict=True))
    panels = [Panel.read(lens, lens_of[lens], psf_of[lens]) for lens in lenses_to_draw(settings, metrics)]
    figures.save(figures.figure_of(panels), [figure, figure_svg, figure_pdf])


def lenses_to_draw(settings: Claims, metrics: Sequence[Path]) -> list[str]:
    """Return the lens of each claim, and the strongest baseline of the claims."""
    metrics_of = dict(zip(settings.baseline_keys, metrics, strict=True))
    strongest = Measurements({}, metrics_of).strongest_baseline(settings.claims[0], *settings.seeds)
    return [*(claim.lens for claim in settings.claims), strongest]
