"""One front door: what a rule of the workflow calls is what a person can type.

    tasklens design config/config.yaml doublet-tasklens --seed 0

Files are read and written below results/<study name>/. torch is imported inside the commands that need it.
"""

import argparse
import sys
import warnings
from pathlib import Path

from tasklens import claims, jobs
from tasklens.arguments import parser
from tasklens.files import FileError
from tasklens.layout import Layout, restored
from tasklens.study import Study, StudyError


def images(study: Study, args: argparse.Namespace) -> None:
    """render or read the pictures and cut them into train, minival and test"""
    from tasklens.recognition import data

    layout = Layout.of(study)
    for split, pictures in data.make(jobs.images(study)).items():
        data.write(pictures, Path(layout.images(split)))
        print(f"{split}: {len(pictures)} pictures of {len(pictures.classes)} classes", file=sys.stderr)


def reference(study: Study, args: argparse.Namespace) -> None:
    """train a classifier on the sharp pictures, or take its published weights"""
    from tasklens.files import write_tensors
    from tasklens.recognition import classifiers, data, training

    layout, job = Layout.of(study), jobs.reference(study, args.classifier)
    pictures = data.read(Path(layout.images("train")))
    training.reseed(0)
    recogniser = classifiers.build(job.classifier, len(pictures.classes))
    if job.classifier.training is not None:
        training.fit(recogniser, pictures, job.classifier.training, 0, f"reference {args.classifier}")
    weights = recogniser.network.state_dict()
    write_tensors(Path(layout.reference(args.classifier)), weights, {"model": job.classifier.model})


def design(study: Study, args: argparse.Namespace) -> None:
    """design a lens and write its prescription, figures and history"""
    from tasklens.design import methods
    from tasklens.files import write_rows
    from tasklens.optics import prescription
    from tasklens.recognition import classifiers, data

    layout, job = Layout.of(study), jobs.design(study, args.lens, args.seed)
    recogniser = pictures = None
    if job.classifier is not None:
        pictures = data.read(Path(layout.images("train")))
        recogniser = classifiers.build(job.classifier, len(pictures.classes), Path(layout.reference(study.supervisor)))
    rivals = {}
    for name in jobs.imaging_rivals(study, args.lens):
        metrics = Path(layout.metrics(name, args.seed, study.supervisor))
        rivals[name] = (prescription.read(Path(layout.lens(name, args.seed)))[0].lens, metrics)
    history: list[dict] = []
    lens, notes = methods.design(job, recogniser, pictures, rivals, history)
    write_rows(Path(layout.history(args.lens, args.seed)), history)
    path = Path(layout.lens(args.lens, args.seed))
    prescription.write(path, prescription.Prescription(lens), notes)


def psf(study: Study, args: argparse.Namespace) -> None:
    """trace the PSF grid of a lens once, for everything after it"""
    from tasklens.design.start import view
    from tasklens.files import write_tensors
    from tasklens.optics import prescription
    from tasklens.optics.analysis import evaluation_psf

    layout, job = Layout.of(study), jobs.psf(study, args.lens)
    lens = prescription.read(Path(layout.lens(args.lens, args.seed)))[0].lens
    grid = evaluation_psf(lens, view(job.spec), job.rays)
    notes = {
        "fields_mm": job.spec.fields_mm,
        "wavelengths_um": job.spec.wavelengths_um,
        "pixel_pitch_um": job.spec.pixel_pitch_um,
        "energy_inside": grid.sum((-2, -1)).tolist(),
        "rays": job.rays,
    }
    write_tensors(Path(layout.psf(args.lens, args.seed)), {"psf": grid.float()}, notes)


def tail(study: Study, args: argparse.Namespace) -> None:
    """trace how the light of a lens spreads: core, tail, and energy encircled by each radius"""
    from tasklens.design.start import view
    from tasklens.files import write_rows
    from tasklens.optics import prescription
    from tasklens.optics.tail import tail

    layout, job = Layout.of(study), jobs.psf(study, args.lens)
    lens = prescription.read(Path(layout.lens(args.lens, args.seed)))[0].lens
    by_field, curve = tail(lens, view(job.spec), job.rays)
    write_rows(Path(layout.tail(args.lens, args.seed)), by_field)
    write_rows(Path(layout.encircled_energy(args.lens, args.seed)), curve)


def restore(study: Study, args: argparse.Namespace) -> None:
    """train the restoration network on the captures of a lens"""
    from restoration import training
    from tasklens.files import read_tensors, write_rows, write_tensors
    from tasklens.imaging import Camera
    from tasklens.recognition import data

    layout, job = Layout.of(study), jobs.restore(study, args.lens, args.seed)
    grid = read_tensors(Path(layout.psf(args.lens, args.seed)))[0]["psf"]
    camera = Camera(grid, job.capture.outside, job.capture.colour)
    train, minival = (data.read(Path(layout.images(split))) for split in ("train", "minival"))
    history: list[dict] = []
    network = training.train(job.restoration, train, minival, camera, job.seed, history)
    write_rows(Path(layout.restoration_history(args.lens, args.seed)), history)
    write_tensors(Path(layout.restoration(args.lens, args.seed)), network.state_dict(), {})


def fine_tune(study: Study, args: argparse.Namespace) -> None:
    """fine-tune a classifier on the captures of a lens, and measure it on every field"""
    from restoration.stored import sight
    from tasklens.files import write_rows, write_tensors
    from tasklens.recognition import classifiers, data, evaluation, training

    layout = Layout.of(study)
    job = jobs.fine_tune(study, args.lens, args.classifier, args.seed, args.restored)
    name = restored(args.classifier) if args.restored else args.classifier
    splits = {split: data.read(Path(layout.images(split))) for split in ("train", "minival", "test")}
    recogniser = classifiers.build(
        job.classifier, len(splits["train"].classes), Path(layout.reference(args.classifier))
    )
    paths = Path(layout.psf(args.lens, args.seed)), Path(layout.restoration(args.lens, args.seed))
    seen = sight(job.capture, job.restoration, *paths)
    training.fit(recogniser, splits["train"], job.training, job.seed, f"fine-tune {name}", seen.one_field)
    rows, by_picture = evaluation.measure(recogniser, splits, seen)
    common = {
        "elements": job.elements,
        "design": job.design,
        "classifier": args.classifier,
        "restored": args.restored,
        "seed": job.seed,
    }
    weights = recogniser.network.state_dict()
    write_tensors(Path(layout.classifier(args.lens, args.seed, name)), weights, {"model": job.classifier.model})
    write_rows(Path(layout.metrics(args.lens, args.seed, name)), [common | row for row in rows])
    write_rows(Path(layout.pictures(args.lens, args.seed, name)), by_picture)


def reproduce(study: Study, args: argparse.Namespace) -> None:
    """recognise the test pictures again with the stored weights, through the stored PSFs"""
    from restoration.stored import sight
    from tasklens.files import write_rows
    from tasklens.recognition import classifiers, data, evaluation

    layout = Layout.of(study)
    job = jobs.reproduce(study, args.lens, args.classifier, args.restored)
    name = restored(args.classifier) if args.restored else args.classifier
    pictures = data.read(Path(layout.images("test")))
    weights = Path(layout.classifier(args.lens, args.seed, name))
    recogniser = classifiers.build(job.classifier, len(pictures.classes), weights).eval()
    paths = Path(layout.psf(args.lens, args.seed)), Path(layout.restoration(args.lens, args.seed))
    correct, _ = evaluation.evaluate(recogniser, pictures, sight(job.capture, job.restoration, *paths))
    rows = evaluation.by_picture(correct, pictures)
    write_rows(Path(layout.reproduced(args.lens, args.seed, name)), rows)


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


def verify(study: Study, args: argparse.Namespace) -> int:
    """check the limits of all lenses and that all accuracies come out again; print failures and verdicts"""
    from tasklens.report import verification

    layout = Layout.of(study)
    findings = verification.verify(jobs.verify(study), layout)
    print(Path(layout.table("verdicts", "md")).read_text())
    print(verification.summary(findings))  # all on standard output: Snakemake shows no log under --quiet
    return 1 if findings.failures else 0


def figure(study: Study, args: argparse.Namespace) -> None:
    """draw a lens: cross-section with rays, spot diagrams and PSFs"""
    from tasklens.design.start import view
    from tasklens.files import read_tensors
    from tasklens.optics import prescription
    from tasklens.report import figures

    layout = Layout.of(study)
    shown, content = prescription.read(Path(layout.lens(args.lens, args.seed)))
    grid = read_tensors(Path(layout.psf(args.lens, args.seed)))[0]["psf"]
    spec = jobs.psf(study, args.lens).spec
    path = Path(layout.figure(args.lens, args.seed))
    figures.draw(path, args.lens, shown.lens, view(spec), grid, content["figures"])


def analyse(args: argparse.Namespace) -> None:
    """print the table of a lens: its figures by field and its aberrations by surface, newly computed from its file"""
    from tasklens.optics import prescription
    from tasklens.optics.datasheet import figures, seidel_by_surface, view_of
    from tasklens.report import certificate

    found, content = prescription.read(args.file)
    lens = found.lens
    view = view_of(lens, content, str(args.file))
    computed = content | {"figures": figures(lens, view, args.rays)}
    print(certificate.markdown(str(args.file), view.fields.tolist(), computed, seidel_by_surface(lens, view)), end="")


def check(study: Study, args: argparse.Namespace) -> None:
    """say what a study file describes, or what is wrong with it and with its lenses from outside"""
    if study.outside:
        from tasklens.design import outside
        from tasklens.design.start import view

        for entry in study.outside.values():
            spec = study.spec_of(entry.elements)
            outside.fit(entry, view(spec), spec.f_number, study.evaluation_rays)
    if args.networks:
        from tasklens.recognition import classifiers

        for name, classifier in study.classifiers.items():
            classifiers.check(name, classifier, study.images.size)
    print(f"{study.name}: {len(study.lenses)} lenses, {len(study.classifiers)} classifiers, seeds {list(study.seeds)}")


STAGES = {
    check: ("--networks",),
    images: (),
    reference: ("classifier",),
    design: ("lens", "--seed"),
    psf: ("lens", "--seed"),
    tail: ("lens", "--seed"),
    restore: ("lens", "--seed"),
    fine_tune: ("lens", "classifier", "--seed", "--restored"),
    reproduce: ("lens", "classifier", "--seed", "--restored"),
    table: ("table", "--partial"),
    psf_tail: (),
    verdicts: (),
    regimes: (),
    ablation: ("ablation",),
    verify: (),
    figure: ("lens", "--seed"),
}


def main(argv: list[str] | None = None) -> int:
    """Run one stage; a mistake in the study or its data ends in exit status 2, a failed `verify` in 1."""
    args = parser(__doc__.splitlines()[0], STAGES, analyse).parse_args(argv)
    # torch's word to itself, at the first forward-mode derivative of a process
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
    try:
        return args.run(args) or 0
    except (StudyError, FileError, FileNotFoundError) as error:
        print(f"tasklens: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
