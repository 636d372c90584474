"""Simulated production of a lens: accuracy of built lenses, sensitivity to errors, and allotted tolerances."""

from collections.abc import Sequence
from pathlib import Path

import torch

from tasklens.camera.imaging import PsfCamera
from tasklens.design import production
from tasklens.design.production import Images, Production
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing import monte_carlo
from tasklens.optics.tolerancing.manufacturing_errors import errors
from tasklens.optics.tolerancing.sensitivity import displacements, traced_displacements
from tasklens.optics.view import view_of_spec
from tasklens.recognition import classifiers, dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows, write_text
from tasklens.show import tolerance_page
from tasklens.study.built_lenses import ProductionJob

_RAYS = 512  # per field and colour, for sensitivities
_WORST = 10  # number of errors whose effect on accuracy is also measured, one at a time


def run(
    settings: ProductionJob,
    lens: Path,
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
    nominal, view = prescription.read(lens)[0].lens, view_of_spec(settings.spec).at(settings.centres)
    graded = view.at(sum(settings.grading, ()))
    images, selection = (dataset.read(*split, device=device) for split in (test, minival))
    network = classifiers.build(settings.classifier, images.classes, weights).to(device)
    classifier = classifiers.frozen(network, images.images)
    illumination = None
    if settings.capture.sensor is not None:  # it takes seconds
        illumination = relative_illumination(nominal, graded).to(device)

    def pipeline(lens: Lens) -> CapturePipeline:
        grid = evaluation_psf(lens, graded, production.RAYS).to(device)
        return CapturePipeline(PsfCamera.of(settings.capture, grid, illumination), turns=len(settings.grading))

    model = Production(nominal, view, errors(nominal, tolerances.grade), pipeline, classifier)
    test_images = _images(images, tolerances.images)
    displacements_um = displacements(nominal, view, model.errors, _RAYS)
    rows = production.built_lenses(model, tolerances.lenses, settings.seed, test_images, checkpoint)
    worst = displacements_um.argsort(descending=True)[:_WORST].tolist()
    changes = production.one_at_a_time(model, worst, rows[0]["accuracy"], test_images, checkpoint)
    count = min(tolerances.lenses, monte_carlo.TRIED)
    drawing_displacements = monte_carlo.both_axes(model.errors, displacements_um)
    minival_images = _images(selection, tolerances.images)
    factors = production.widest_tolerances(
        model, drawing_displacements, count, settings.seed, minival_images, checkpoint
    )
    error_rows = monte_carlo.error_rows(
        model.errors,
        factors,
        moved_um=displacements_um.tolist(),
        traced_um=traced_displacements(nominal, view, model.errors, _RAYS).tolist(),
        accuracy_change=[changes.get(k) for k in range(len(model.errors))],
    )
    write_rows(lenses, rows)
    write_rows(error_table, error_rows)
    title = f"{settings.lens}, seed {settings.seed}"
    write_text(page, tolerance_page.markdown(title, tolerances.grade.name, rows, error_rows, len(test_images[1])))


def _images(images: ImageDataset, count: int) -> Images:
    """Return up to `count` images and their labels; the selection is always the same."""
    order = torch.randperm(len(images), generator=torch.Generator().manual_seed(0))
    return images.batch(order[:count])
