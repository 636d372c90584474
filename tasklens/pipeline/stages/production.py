"""Production of a lens in simulation: the accuracy of built lenses, the errors that matter, and allotted tolerances."""

import torch

from tasklens.design import production
from tasklens.design.production import Images, Production
from tasklens.imaging import Camera
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.tolerancing.allocation import both_axes
from tasklens.optics.tolerancing.errors import errors
from tasklens.optics.tolerancing.sensitivity import displacements, traced_displacements
from tasklens.optics.view import view_of_spec
from tasklens.recognition import classifiers, dataset
from tasklens.recognition.dataset import ImageDataset
from tasklens.report import tolerance_page
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_rows, write_text
from tasklens.study.settings import Slice

_RAYS = 512  # per field and colour, of sensitivities
_WORST = 10  # errors that are also measured by accuracy, one at a time


def run(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write a row for the design and each built lens, a row for each error, and a page that tells both."""
    device = claim()
    wanted = settings.tolerances
    lens, view = prescription.read(inputs.lens)[0].lens, view_of_spec(settings.spec)
    test, minival = (dataset.read(*files, device=device) for files in (inputs.test, inputs.minival))
    trained = classifiers.build(settings.classifier, test.classes, inputs.weights).to(device)
    classifier = classifiers.frozen(trained, test.images)
    illumination = psf_files.read(inputs.psf).illumination.to(device)
    studied = Production(
        lens,
        view,
        errors(lens, wanted.grade),
        lambda grid: Camera.of(settings.capture, grid.to(device), illumination),
        classifier,
    )
    shown = _images(test, wanted.images)
    moved_um = displacements(lens, view, studied.errors, _RAYS)
    rows = production.built_lenses(studied, wanted.lenses, settings.seed, shown, checkpoint)
    worst = moved_um.argsort(descending=True)[:_WORST].tolist()
    changes = production.one_at_a_time(studied, worst, rows[0]["accuracy"], shown, checkpoint)
    tried = min(wanted.lenses, production.TRIED)
    by_drawing = both_axes(studied.errors, moved_um)
    spared = _images(minival, wanted.images)
    allotted = production.allotted(studied, by_drawing, tried, settings.seed, spared, checkpoint)
    found = [
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
            zip(studied.errors, traced_displacements(lens, view, studied.errors, _RAYS), strict=True)
        )
    ]
    write_rows(outputs.lenses, rows)
    write_rows(outputs.errors, found)
    title = f"{settings.lens}, seed {settings.seed}"
    page = tolerance_page.markdown(title, wanted.grade.name, rows, found, len(shown[1]))
    write_text(outputs.page, page)


def _images(images: ImageDataset, count: int) -> Images:
    """Return up to `count` images and their labels, always the same."""
    order = torch.randperm(len(images), generator=torch.Generator().manual_seed(0))
    return images.batch(order[:count])
