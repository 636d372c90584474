"""The stages that make and measure: pictures, classifiers, lenses, PSFs, restorations, accuracies.

Files are read and written below results/<study name>/. torch is imported inside the stages that need it.
"""

import argparse
import sys
from pathlib import Path

from tasklens.pipeline import jobs
from tasklens.pipeline.digest import code, of_folder
from tasklens.pipeline.layout import Layout, restored
from tasklens.study.settings import Frozen
from tasklens.study.study import Study


def images(study: Study, args: argparse.Namespace) -> None:
    """render or read the pictures and cut them into train, minival and test"""
    from tasklens.recognition import dataset as data

    layout, job = Layout.of(study), jobs.images(study)
    paths = {split: Path(layout.images(split)) for split in data.SPLITS}
    checkpoint = _checkpoint(layout, "images", "all", job, [], of_folder(job.folder) if job.folder else "")
    data.make(job, paths, args.threads, checkpoint)
    checkpoint.remove()
    for split, path in paths.items():
        pictures = data.read(path)
        print(f"{split}: {len(pictures)} pictures of {len(pictures.classes)} classes", file=sys.stderr)


def reference(study: Study, args: argparse.Namespace) -> None:
    """train a classifier on the sharp pictures, or take its published weights"""
    from tasklens.recognition import classifiers, training
    from tasklens.recognition import dataset as data
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_tensors

    layout, job = Layout.of(study), jobs.reference(study, args.classifier)
    device = claim()
    pictures = data.read(Path(layout.images("train")), device)
    training.reseed(0)
    recogniser = classifiers.build(job.classifier, pictures.classes).to(device)
    inputs = [Path(layout.images("train")), *filter(None, [job.classifier.weights])]
    checkpoint = _checkpoint(layout, "reference", args.classifier, job, inputs)
    if job.classifier.training is not None:
        label = f"reference {args.classifier}"
        training.fit(recogniser, pictures, job.classifier.training, 0, label, checkpoint=checkpoint)
    weights = recogniser.network.state_dict()
    write_tensors(Path(layout.reference(args.classifier)), weights, {"model": job.classifier.model})
    checkpoint.remove()


def design(study: Study, args: argparse.Namespace) -> None:
    """design a lens and write its prescription, figures and history"""
    from tasklens.design import methods
    from tasklens.optics.io import prescription
    from tasklens.recognition import classifiers
    from tasklens.recognition import dataset as data
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_rows

    layout, job = Layout.of(study), jobs.design(study, args.lens, args.seed)
    recogniser = pictures = None
    inputs = []
    if job.classifier is not None:
        inputs = [Path(layout.images("train")), Path(layout.reference(study.supervisor))]
        device = claim()
        pictures = data.read(inputs[0], device)
        recogniser = classifiers.build(job.classifier, pictures.classes, inputs[1]).to(device)
    rivals = {}
    for name in jobs.imaging_rivals(study, args.lens):
        metrics = Path(layout.metrics(name, args.seed, study.supervisor))
        path = Path(layout.lens(name, args.seed))
        rivals[name] = (prescription.read(path)[0].lens, metrics)
        inputs += [path, metrics]
    history: list[dict] = []
    checkpoint = _checkpoint(layout, "design", f"{args.lens}-seed{args.seed}", job, inputs)
    lens, notes = methods.design(job, recogniser, pictures, rivals, history, checkpoint)
    write_rows(Path(layout.history(args.lens, args.seed)), history)
    path = Path(layout.lens(args.lens, args.seed))
    prescription.write(path, prescription.Prescription(lens), notes)
    checkpoint.remove()


def psf(study: Study, args: argparse.Namespace) -> None:
    """trace the PSF grid of a lens once, for everything after it"""
    from tasklens.optics.analysis.spots import evaluation_psf
    from tasklens.optics.io import prescription
    from tasklens.optics.view import view_of_spec
    from tasklens.runtime.files import write_tensors

    layout, job = Layout.of(study), jobs.psf(study, args.lens)
    lens = prescription.read(Path(layout.lens(args.lens, args.seed)))[0].lens
    grid = evaluation_psf(lens, view_of_spec(job.spec), job.rays)
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
    from tasklens.optics.analysis.tail import tail
    from tasklens.optics.io import prescription
    from tasklens.optics.view import view_of_spec
    from tasklens.runtime.files import write_rows

    layout, job = Layout.of(study), jobs.psf(study, args.lens)
    lens = prescription.read(Path(layout.lens(args.lens, args.seed)))[0].lens
    by_field, curve = tail(lens, view_of_spec(job.spec), job.rays)
    write_rows(Path(layout.tail(args.lens, args.seed)), by_field)
    write_rows(Path(layout.encircled_energy(args.lens, args.seed)), curve)


def restore(study: Study, args: argparse.Namespace) -> None:
    """train the restoration network on the captures of a lens"""
    from restoration import training
    from tasklens.imaging import Camera
    from tasklens.recognition import dataset as data
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import read_tensors, write_rows, write_tensors

    layout, job = Layout.of(study), jobs.restore(study, args.lens, args.seed)
    inputs = [Path(layout.images("train")), Path(layout.images("minival")), Path(layout.psf(args.lens, args.seed))]
    device = claim()
    camera = Camera(read_tensors(inputs[2])[0]["psf"].to(device), job.capture.outside, job.capture.colour)
    train, minival = (data.read(path, device) for path in inputs[:2])
    history: list[dict] = []
    checkpoint = _checkpoint(layout, "restore", f"{args.lens}-seed{args.seed}", job, inputs)
    network = training.train(job.restoration, train, minival, camera, job.seed, history, checkpoint)
    write_rows(Path(layout.restoration_history(args.lens, args.seed)), history)
    write_tensors(Path(layout.restoration(args.lens, args.seed)), network.state_dict(), {})
    checkpoint.remove()


def fine_tune(study: Study, args: argparse.Namespace) -> None:
    """fine-tune a classifier on the captures of a lens, and measure it on every field"""
    from restoration.stored import sight
    from tasklens.recognition import classifiers, evaluation, training
    from tasklens.recognition import dataset as data
    from tasklens.runtime import distributed as team
    from tasklens.runtime.files import write_rows, write_tensors

    layout = Layout.of(study)
    job = jobs.fine_tune(study, args.lens, args.classifier, args.seed, args.restored)
    name = restored(args.classifier) if args.restored else args.classifier
    sharp = Path(layout.reference(args.classifier))
    paths = Path(layout.psf(args.lens, args.seed)), Path(layout.restoration(args.lens, args.seed))
    inputs = [sharp, *(Path(layout.images(split)) for split in data.SPLITS)]
    inputs += [path for path, read in zip(paths, (job.capture, job.restoration), strict=True) if read is not None]
    checkpoint = _checkpoint(layout, "fine_tune", f"{args.lens}-seed{args.seed}-{name}", job, inputs)
    with team.joined() as processes:
        splits = {split: data.read(Path(layout.images(split)), processes.device) for split in data.SPLITS}
        recogniser = classifiers.build(job.classifier, splits["train"].classes, sharp).to(processes.device)
        seen = sight(job.capture, job.restoration, *paths, processes.device)
        found = evaluation.zero_shot(recogniser.eval(), splits["test"], seen, checkpoint) if processes.first else []
        label = f"fine-tune {name}"
        training.fit(recogniser, splits["train"], job.training, job.seed, label, seen.one_field, checkpoint, processes)
    if not processes.first:
        return
    rows, by_picture = evaluation.measure(recogniser, splits, seen, checkpoint)
    common = {
        "elements": job.elements,
        "design": job.design,
        "classifier": args.classifier,
        "restored": args.restored,
        "seed": job.seed,
    }
    weights = recogniser.network.state_dict()
    write_tensors(Path(layout.classifier(args.lens, args.seed, name)), weights, {"model": job.classifier.model})
    write_rows(Path(layout.metrics(args.lens, args.seed, name)), [common | row for row in found + rows])
    write_rows(Path(layout.pictures(args.lens, args.seed, name)), by_picture)
    checkpoint.remove()


def reproduce(study: Study, args: argparse.Namespace) -> None:
    """recognise the test pictures again with the stored weights, through the stored PSFs"""
    from restoration.stored import sight
    from tasklens.recognition import classifiers, evaluation
    from tasklens.recognition import dataset as data
    from tasklens.runtime.devices import claim
    from tasklens.runtime.files import write_rows

    layout = Layout.of(study)
    job = jobs.reproduce(study, args.lens, args.classifier, args.restored)
    name = restored(args.classifier) if args.restored else args.classifier
    device = claim()
    inputs = [Path(layout.images("test")), Path(layout.classifier(args.lens, args.seed, name))]
    pictures = data.read(inputs[0], device)
    recogniser = classifiers.build(job.classifier, pictures.classes, inputs[1]).eval().to(device)
    paths = Path(layout.psf(args.lens, args.seed)), Path(layout.restoration(args.lens, args.seed))
    seen = sight(job.capture, job.restoration, *paths, device)
    inputs += [path for path, read in zip(paths, (job.capture, job.restoration), strict=True) if read is not None]
    checkpoint = _checkpoint(layout, "reproduce", f"{args.lens}-seed{args.seed}-{name}", job, inputs)
    correct, _ = evaluation.evaluate(recogniser, pictures, seen, "test", checkpoint)
    write_rows(Path(layout.reproduced(args.lens, args.seed, name)), evaluation.by_picture(correct, pictures))
    checkpoint.remove()


def _checkpoint(layout: Layout, stage: str, name: str, job: Frozen, inputs: list[Path], source: str = ""):
    """That of the job `name` of a stage; what a job of that name has left that computed something else, is removed."""
    from tasklens.runtime.checkpoints import Checkpoint, key

    path = Path(layout.checkpoint(stage, name, key(job.model_dump_json(), code(stage), source, inputs=inputs)))
    for other in path.parent.glob(f"{stage}-{name}-{16 * '[0-9a-f]'}.pt"):
        if other != path:
            other.unlink(missing_ok=True)  # several processes that train together look here
    return Checkpoint(path)
