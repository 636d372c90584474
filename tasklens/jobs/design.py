"""Design of a lens, or its import from a file; and its PSFs."""

from collections.abc import Sequence
from pathlib import Path

from tasklens.design import methods
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import view_of_spec
from tasklens.recognition import classifiers, dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows
from tasklens.study.lens_entries import LensDesign


def run(
    settings: LensDesign,
    train: Sequence[Path],
    weights: Path | None,
    files: Sequence[Path],
    candidates: Sequence[Path],
    starts: Sequence[Path],
    metrics: Sequence[Path],
    lens: Path,
    history: Path,
    psf: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write the prescription with its figures and margins, the history of the design, and the PSFs at all fields.

    Args:
        train: training images and their labels or objects; empty for a design without images.
        weights: weights of the network, if a network supervises the design.
        files: files of an imported lens; `settings` has their paths, and the rule waits for them.
        candidates: candidate starts; the best by the criterion is the start.
        starts, metrics: candidate starts and their measurements; the most accurate lens is the start.
    """
    classifier = images = task = None
    if settings.network is not None:
        from tasklens.recognition import object_tasks, objects, task_networks

        device = claim()
        scenes = objects.read(*train, device=device)
        name, size = str(settings.task), scenes.images.shape[-1]
        images, task = scenes.as_images(), object_tasks.make(name, settings.network, scenes)
        classifier = task_networks.load(name, settings.network, scenes.classes, size, weights).to(device)
    elif train:
        device = claim()
        images = dataset.read(*train, device=device)
        if settings.classifier is not None:
            classifier = classifiers.build(settings.classifier, images.classes, weights).to(device)
    accuracies = []
    if starts:
        from tasklens.recognition.metrics import mean_metrics, worst_field_metrics

        # A joint descent does not recover a field that is lost at the start: docs/results/regimes.
        measure = worst_field_metrics if isinstance(settings.entry.start, tuple) else mean_metrics
        accuracies = [measure(path)["minival_accuracy"] for path in metrics]
    start_lenses = dict(zip(settings.starts, zip(_lenses(starts), accuracies, strict=True), strict=True))
    candidate_lenses = dict(zip(settings.candidates, _lenses(candidates), strict=True))
    design, notes, rows, _ = methods.design(
        settings, classifier, images, start_lenses, candidate_lenses, checkpoint, task
    )
    view = view_of_spec(settings.spec)
    write_rows(history, rows)
    prescription.write(lens, prescription.Prescription(design, object_distance_mm=view.object_distance), notes)
    design = prescription.read(lens)[0].lens
    grid = evaluation_psf(design, view, settings.rays)
    psfs = FieldPsfs(grid, relative_illumination(design, view))
    psf_files.write(psf, psfs, psf_notes(view, grid) | {"rays": settings.rays})


def _lenses(paths: Sequence[Path]) -> list[Lens]:
    return [prescription.read(path)[0].lens for path in paths]
