"""Figures of one lens, or of a task-driven and the best imaging lens (the paper's figure 3)."""

from pathlib import Path

from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.io import prescription
from tasklens.report import figures
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files, read_tensors
from tasklens.study.settings import Slice


def one(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw a lens: cross-section with rays, spot diagrams and PSFs."""
    figures.draw(outputs.figure, [_panel(settings.title, inputs.lens, inputs.psf)])


def comparison(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw the lens of a claim and its strongest baseline."""
    lenses = (settings.claim.lens, Measurements({}, inputs.metrics).strongest_baseline(settings.claim, settings.seed))
    figures.draw(outputs.figure, [_panel(lens, inputs.lenses[lens], inputs.psfs[lens]) for lens in lenses])


def _panel(title: str, path: Path, psf: Path) -> figures.Panel:
    found, content = prescription.read(path)
    view = view_of(found.lens, content, str(path))
    return figures.Panel(title, found.lens, view, read_tensors(psf)[0]["psf"], content["figures"])
