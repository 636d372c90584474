"""Drawing of a lens in one figure."""

from pathlib import Path

from tasklens.show import figures
from tasklens.show.panel import Panel
from tasklens.study.report_jobs import DrawingJob


def run(settings: DrawingJob, lens: Path, psf: Path, figure: Path, figure_svg: Path, figure_pdf: Path) -> None:
    """Draw the lens as PNG, SVG and PDF."""
    figures.save(figures.figure_of([Panel.read(settings.lens, lens, psf)]), [figure, figure_svg, figure_pdf])
