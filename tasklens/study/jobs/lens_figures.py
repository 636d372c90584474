"""Figures of lenses: each lens, and the task-driven lenses with the best imaging lens (the paper's figure 3)."""

from collections.abc import Sequence
from pathlib import Path

from tasklens.show import figures
from tasklens.show.panel import Panel
from tasklens.study.claims import Claims
from tasklens.study.report.measurements import Measurements


def draw(name: str, lens: Path, psf: Path, figure: Path, figure_svg: Path, figure_pdf: Path) -> None:
    """Draw a lens in one figure as PNG, SVG and PDF."""
    figures.save(figures.figure_of([Panel.read(name, lens, psf)]), [figure, figure_svg, figure_pdf])


def compare(
    settings: Claims,
    lenses: Sequence[Path],
    psfs: Sequence[Path],
    metrics: Sequence[Path],
    figure: Path,
    figure_svg: Path,
    figure_pdf: Path,
) -> None:
    """Draw the lens of each claim, and the strongest baseline of the claims, in one figure.

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
