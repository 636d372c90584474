"""The stages that tell: tables, verdicts, pages and pictures, from what the others have measured.

torch is imported inside the stages that need it.
"""

import argparse
from pathlib import Path

from tasklens.pipeline import jobs
from tasklens.pipeline.layout import Layout
from tasklens.study import claims
from tasklens.study.study import Study


def table(study: Study, args: argparse.Namespace) -> None:
    """make one table of the paper as CSV, Markdown and LaTeX"""
    from tasklens.report import tables

    tables.make(jobs.table(study, args.table), Layout.of(study), study.name, partial=args.partial)


def psf_tail(study: Study, args: argparse.Namespace) -> None:
    """make the table of the tails of all PSFs, and their curves of encircled energy"""
    from tasklens.report import tails

    tails.make(jobs.psf_tail(study), Layout.of(study), study.name)


def verdicts(study: Study, args: argparse.Namespace) -> None:
    """judge the paper's claims by the measured accuracies"""
    from tasklens.report import verdicts

    verdicts.make(claims.verdicts(study), Layout.of(study), study.name)


def regimes(study: Study, args: argparse.Namespace) -> None:
    """make the map of what task-driven design gains over element counts and specifications"""
    from tasklens.report import regimes

    regimes.make(claims.regimes(study), Layout.of(study), study.name)


def ablation(study: Study, args: argparse.Namespace) -> None:
    """make the table of one ablation: a design beside its variants"""
    from tasklens.report import ablations

    ablations.make(claims.ablation(study, args.ablation), Layout.of(study), study.name)


def certificate(study: Study, args: argparse.Namespace) -> None:
    """write the page of a lens: its figures, its limits, and who would make it"""
    from tasklens.optics.analysis.datasheet import seidel_by_surface, view_of
    from tasklens.optics.analysis.shapes import shapes
    from tasklens.optics.analysis.tolerances import errors_by_part
    from tasklens.optics.io import prescription
    from tasklens.report import certificate, making
    from tasklens.runtime.files import write_text

    layout = Layout.of(study)
    path = Path(layout.lens(args.lens, args.seed))
    found, content = prescription.read(path)
    lens = found.lens
    view = view_of(lens, content, str(path))
    title = f"{args.lens}, seed {args.seed}"
    figures = certificate.markdown(title, view.fields.tolist(), content, seidel_by_surface(lens, view))
    errors = errors_by_part(lens, view, content["figures"]["rays"])
    page = f"{figures}\n{making.markdown(content['margins'], shapes(lens), *errors)}"
    write_text(Path(layout.certificate(args.lens, args.seed)), page)


def figure(study: Study, args: argparse.Namespace) -> None:
    """draw a lens: cross-section with rays, spot diagrams and PSFs"""
    from tasklens.report import figures

    layout = Layout.of(study)
    figures.draw(Path(layout.figure(args.lens, args.seed)), [_panel(layout, args.lens, args.seed)])


def comparison(study: Study, args: argparse.Namespace) -> None:
    """draw the task-driven lens of some elements beside the best imaging lens of as many (the paper's figure 3)"""
    from tasklens.report import figures, verdicts

    layout = Layout.of(study)
    claim = claims.over_imaging(study, args.elements)
    lenses = (claim.lens, verdicts.opponent(claim, args.seed, layout))
    panels = [_panel(layout, lens, args.seed) for lens in lenses]
    figures.draw(Path(layout.comparison(args.elements, args.seed)), panels)


def _panel(layout: Layout, lens: str, seed: int):
    from tasklens.optics.analysis.datasheet import view_of
    from tasklens.optics.io import prescription
    from tasklens.report.figures import Panel
    from tasklens.runtime.files import read_tensors

    path = layout.lens(lens, seed)
    shown, content = prescription.read(Path(path))
    grid = read_tensors(Path(layout.psf(lens, seed)))[0]["psf"]
    return Panel(lens, shown.lens, view_of(shown.lens, content, path), grid, content["figures"])


def verify(study: Study, args: argparse.Namespace) -> int:
    """check the limits of all lenses and that all accuracies come out again; print failures and verdicts"""
    from tasklens.report import verification

    layout = Layout.of(study)
    findings = verification.verify(jobs.verify(study), layout)
    print(Path(layout.table("verdicts", "md")).read_text())
    print(verification.summary(findings))  # all on standard output: Snakemake shows no log under --quiet
    return 1 if findings.failures else 0
