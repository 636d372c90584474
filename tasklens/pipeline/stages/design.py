"""Design of a lens, or import from its file, and its PSFs."""

from tasklens.design import methods
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.optics.psf import psf_notes
from tasklens.optics.view import view_of_spec
from tasklens.recognition import classifiers, dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_rows
from tasklens.study.lens_entries import LensDesign


def run(settings: LensDesign, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the prescription with its figures and margins, the history of the design, and the PSFs at all fields."""
    classifier = train = task = None
    if settings.network is not None:
        from tasklens.recognition import object_tasks, objects, task_networks

        device = claim()
        found = objects.read(*inputs.train, device=device)
        name, size = str(settings.task), found.images.shape[-1]
        train, task = found.as_images(), object_tasks.make(name, settings.network, found)
        classifier = task_networks.load(name, settings.network, found.classes, size, inputs.weights).to(device)
    elif inputs.train:
        device = claim()
        train = dataset.read(*inputs.train, device=device)
        if settings.classifier is not None:
            classifier = classifiers.build(settings.classifier, train.classes, inputs.weights).to(device)
    starts = {}
    if inputs.starts:
        from tasklens.recognition.metrics import least_metrics, mean_metrics

        # A joint descent does not find a field again that is lost where it begins: docs/results/regimes.
        judged = least_metrics if settings.entry.start != "best_imaging" else mean_metrics
        starts = {
            name: (prescription.read(path)[0].lens, judged(inputs.metrics[name])["minival_accuracy"])
            for name, path in inputs.starts.items()
        }
    candidates = {name: prescription.read(path)[0].lens for name, path in (inputs.candidates or {}).items()}
    lens, notes, history = methods.design(settings, classifier, train, starts, candidates, checkpoint, task)
    write_rows(outputs.history, history)
    prescription.write(outputs.lens, prescription.Prescription(lens), notes)
    view = view_of_spec(settings.spec)
    lens = prescription.read(outputs.lens)[0].lens
    grid = evaluation_psf(lens, view, settings.rays)
    psfs = FieldPsfs(grid, relative_illumination(lens, view))
    psf_files.write(outputs.psf, psfs, psf_notes(view, grid) | {"rays": settings.rays})
