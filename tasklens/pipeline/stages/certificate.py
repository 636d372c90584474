"""The certificate of one lens, and the figure of a task-driven and the best imaging lens (the paper's figure 3)."""

from pathlib import Path

from tasklens.optics.analysis.datasheet import seidel_by_surface, view_of
from tasklens.optics.analysis.shapes import shapes
from tasklens.optics.analysis.tolerances import errors_by_part
from tasklens.optics.io import prescription
from tasklens.report import certificate, figures, manufacturability
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files, read_tensors, write_text
from tasklens.study.settings import Slice


def one(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the page of a lens, with figures, aberrations, limits and manufacturability, and draw it."""
    found, content = prescription.read(inputs.lens)
    lens = found.lens
    view = view_of(lens, content, str(inputs.lens))
    title = f"{settings.lens}, seed {settings.seed}"
    page = certificate.markdown(title, view.fields.tolist(), content, seidel_by_surface(lens, view))
    errors = errors_by_part(lens, view, content["figures"]["rays"])
    write_text(outputs.page, f"{page}\n{manufacturability.markdown(content['margins'], shapes(lens), *errors)}")
    figures.draw(outputs.figure, [_panel(settings.lens, inputs.lens, inputs.psf)])


def comparison(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw the lens of a claim and its strongest baseline."""
    lenses = (settings.claim.lens, Measurements({}, inputs.metrics).strongest_baseline(settings.claim, settings.seed))
    figures.draw(outputs.figure, [_panel(lens, inputs.lenses[lens], inputs.psfs[lens]) for lens in lenses])


def _panel(title: str, path: Path, psf: Path) -> figures.Panel:
    found, content = prescription.read(path)
    view = view_of(found.lens, content, str(path))
    return figures.Panel(title, found.lens, view, read_tensors(psf)[0]["psf"], content["figures"])
