"""Production of a lens in simulation: the accuracy of built lenses, the errors that matter, and allotted tolerances."""

from collections.abc import Sequence
from pathlib import Path

import torch

from tasklens.design import production
from tasklens.design.production import Images, Production
from tasklens.imaging import PsfCamera
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.tolerancing import allocation
from tasklens.optics.tolerancing.errors import errors
from tasklens.optics.tolerancing.sensitivity import displacements, traced_displacements
from tasklens.optics.view import view_of_spec
from tasklens.recognition import classifiers, dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.report import tolerance_page
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows, write_text
from tasklens.study.built_lenses import ProductionJob

_RAYS = 512  # per field and colour, of sensitivities
_WORST = 10  # errors that are also measured by accuracy, one at a time


def run(
    settings: ProductionJob,
    lens: Path,
    psf: Path,
    weights: Path,
    minival: Sequence[Path],
    test: Sequence[Path],
    lenses: Path,
    error_table: Path,
    page: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write a row for the design and each built lens, a row for each error, and a page that shows both."""
    device = claim()
    tolerances = settings.tolerances
    nominal, view = prescription.read(lens)[0].lens, view_of_spec(settings.spec)
    images, selection = (dataset.read(*split, device=device) for split in (test, minival))
    trained = classifiers.build(settings.classifier, images.classes, weights).to(device)
    classifier = classifiers.frozen(trained, images.images)
    illumination = psf_files.read(psf).illumination.to(device)
    studied = Production(
        nominal,
        view,
        errors(nominal, tolerances.grade),
        lambda grid: PsfCamera.of(settings.capture, grid.to(device), illumination),
        classifier,
    )
    shown = _images(images, tolerances.images)
    moved_um = displacements(nominal, view, studied.errors, _RAYS)
    rows = production.built_lenses(studied, tolerances.lenses, settings.seed, shown, checkpoint)
    worst = moved_um.argsort(descending=True)[:_WORST].tolist()
    changes = production.one_at_a_time(studied, worst, rows[0]["accuracy"], shown, checkpoint)
    tried = min(tolerances.lenses, allocation.TRIED)
    by_drawing = allocation.both_axes(studied.errors, moved_um)
    spared = _images(selection, tolerances.images)
    allotted = production.allotted(studied, by_drawing, tried, settings.seed, spared, checkpoint)
    error_rows = [
        {
            "error": error.name,
            "unit": error.unit,
            "tolerance": error.tolerance,
            "moved_um": float(moved_um[k]),
            "traced_um": float(traced),
            "accuracy_change": changes.get(k),
            "allotted": None if allotted is None else error.tolerance * float(allotted[k]),
        }
        for k, (error, traced) in enumerate(
            zip(studied.errors, traced_displacements(nominal, view, studied.errors, _RAYS), strict=True)
        )
    ]
    write_rows(lenses, rows)
    write_rows(error_table, error_rows)
    title = f"{settings.lens}, seed {settings.seed}"
    write_text(page, tolerance_page.markdown(title, tolerances.grade.name, rows, error_rows, len(shown[1])))


def _images(images: ImageDataset, count: int) -> Images:
    """Return up to `count` images and their labels, always the same."""
    order = torch.randperm(len(images), generator=torch.Generator().manual_seed(0))
    return images.batch(order[:count])
