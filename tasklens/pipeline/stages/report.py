"""The stages that tell: tables, verdicts, pages and figures, from what the others have measured.

Each is a function of settings, inputs and outputs. torch is imported inside the stages that need it.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from tasklens.pipeline.stage import Files, Slice

if TYPE_CHECKING:
    from tasklens.report.figures import Panel
    from tasklens.study.claims import AblationClaims, Claims
    from tasklens.study.tables import TableContents, TailContents, VerificationContents


def table(settings: "TableContents", inputs: Files, outputs: Files) -> None:
    """make one table of the paper as CSV, Markdown and LaTeX"""
    from tasklens.report import tables
    from tasklens.report.measurements import Measurements

    tables.make(settings, Measurements(inputs.lenses, inputs.metrics), inputs.paper, vars(outputs))


def psf_tail(settings: "TailContents", inputs: Files, outputs: Files) -> None:
    """make the table of the tails of all PSFs, and their curves of encircled energy"""
    from tasklens.report import tails

    tails.make(settings, inputs.psf_tail, inputs.encircled_energy, vars(outputs))


def verdicts(settings: "Claims", inputs: Files, outputs: Files) -> None:
    """judge the paper's claims by the measured accuracies"""
    from tasklens.report import verdicts
    from tasklens.report.measurements import Measurements

    verdicts.make(settings, Measurements(inputs.lenses, inputs.metrics, inputs.predictions), vars(outputs))


def regimes(settings: "Claims", inputs: Files, outputs: Files) -> None:
    """make the map of what task-driven design gains over element counts and specifications"""
    from tasklens.report import regimes
    from tasklens.report.measurements import Measurements

    regimes.make(settings, Measurements(inputs.lenses, inputs.metrics, inputs.predictions), vars(outputs))


def ablation(settings: "AblationClaims", inputs: Files, outputs: Files) -> None:
    """make the table of one ablation: a design beside its variants"""
    from tasklens.report import ablations
    from tasklens.report.measurements import Measurements

    ablations.make(settings, Measurements(inputs.lenses, inputs.metrics, inputs.predictions), vars(outputs))


def certificate(settings: Slice, inputs: Files, outputs: Files) -> None:
    """write the page of a lens: its figures, its limits, and its manufacturability"""
    from tasklens.optics.analysis.datasheet import seidel_by_surface, view_of
    from tasklens.optics.analysis.shapes import shapes
    from tasklens.optics.analysis.tolerances import errors_by_part
    from tasklens.optics.io import prescription
    from tasklens.report import certificate, manufacturability
    from tasklens.runtime.files import write_text

    found, content = prescription.read(inputs.lens)
    lens = found.lens
    view = view_of(lens, content, str(inputs.lens))
    figures = certificate.markdown(settings.title, view.fields.tolist(), content, seidel_by_surface(lens, view))
    errors = errors_by_part(lens, view, content["figures"]["rays"])
    write_text(outputs.page, f"{figures}\n{manufacturability.markdown(content['margins'], shapes(lens), *errors)}")


def figure(settings: Slice, inputs: Files, outputs: Files) -> None:
    """draw a lens: cross-section with rays, spot diagrams and PSFs"""
    from tasklens.report import figures

    figures.draw(outputs.figure, [_panel(settings.title, inputs.lens, inputs.psf)])


def comparison(settings: Slice, inputs: Files, outputs: Files) -> None:
    """draw the task-driven lens of some elements beside the best imaging lens of as many (the paper's figure 3)"""
    from tasklens.report import figures
    from tasklens.report.measurements import Measurements

    claim = settings.claim
    metrics = {(lens, claim.classifier, settings.seed): path for lens, path in inputs.metrics.items()}
    lenses = (claim.lens, Measurements({}, metrics).strongest_baseline(claim, settings.seed))
    figures.draw(outputs.figure, [_panel(lens, inputs.lenses[lens], inputs.psfs[lens]) for lens in lenses])


def _panel(title: str, path: Path, psf: Path) -> "Panel":
    from tasklens.optics.analysis.datasheet import view_of
    from tasklens.optics.io import prescription
    from tasklens.report.figures import Panel
    from tasklens.runtime.files import read_tensors

    found, content = prescription.read(path)
    view = view_of(found.lens, content, str(path))
    return Panel(title, found.lens, view, read_tensors(psf)[0]["psf"], content["figures"])


def verify(settings: "VerificationContents", inputs: Files, outputs: Files) -> int:
    """check the limits of all lenses and that all accuracies come out again; print failures and verdicts"""
    from tasklens.report import verification
    from tasklens.report.measurements import Measurements

    measurements = Measurements(inputs.lenses, inputs.metrics, inputs.predictions)
    findings = verification.verify(settings, measurements, inputs.reproduced, inputs.tables)
    print(inputs.verdicts.read_text())
    print(verification.summary(findings))  # all on standard output: Snakemake shows no log under --quiet
    return 1 if findings.failures else 0
