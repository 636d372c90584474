"""Design of a lens, or its import from a file."""

import math
from collections.abc import Sequence
from pathlib import Path

from tasklens.design import methods
from tasklens.optics.io import prescription
from tasklens.recognition import classifiers, dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows
from tasklens.settings.lens_entries import LensDesign


def run(
    settings: LensDesign,
    train: Sequence[Path],
    weights: Path | None,
    files: Sequence[Path],
    starts: Sequence[Path],
    metrics: Sequence[Path],
    lens: Path,
    history: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write the prescription with its figures and margins, and the history of the design.

    Args:
        train: training images and their labels or objects; empty for a design without images.
        weights: weights of the network, if a network supervises the design.
        files: files of an imported lens; `settings` has their paths, and the rule waits for them.
        starts: lenses that the design may start from.
        metrics: their measurements, if the most accurate lens is the start.
    """
    classifier = images = task = None
    if settings.network is not None:
        from tasklens.recognition import object_tasks, objects, task_networks

        device = claim()
        scenes = objects.read(*train, device=device)
        name, size = str(settings.entry.design.task), scenes.images.shape[-1]
        images, task = scenes.as_images(), object_tasks.make(name, settings.network, scenes)
        classifier = task_networks.load(name, settings.network, scenes.classes, size, weights).to(device)
    elif train:
        device = claim()
        images = dataset.read(*train, device=device)
        if settings.classifier is not None:
            classifier = classifiers.build(settings.classifier, images.classes, weights).to(device)
    accuracies = {}
    if metrics:
        from tasklens.recognition.metrics import mean_metrics, worst_field_metrics

        # A joint descent does not recover a field that is lost at the start: docs/results/regimes.
        measure = worst_field_metrics if settings.entry.design.starting_designs else mean_metrics
        measured = (measure(path)["minival_accuracy"] for path in metrics)
        accuracies = dict(zip(settings.starts, measured, strict=True))
    lenses = {name: prescription.read(path)[0].lens for name, path in zip(settings.starts, starts, strict=True)}
    design, notes, rows, _ = methods.design(settings, classifier, images, lenses, accuracies, checkpoint, task)
    write_rows(history, rows)
    distance = settings.spec.object_distance_mm or math.inf
    prescription.write(lens, prescription.Prescription(design, object_distance_mm=distance), notes)
