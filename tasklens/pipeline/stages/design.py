"""Design of a lens, or import from its file."""

from tasklens.design import methods
from tasklens.optics.io import prescription
from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_rows
from tasklens.study.design_settings import LensDesign


def run(settings: LensDesign, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the prescription with its figures and margins, and the history of the design."""
    classifier = train = None
    if settings.classifier is not None:
        from tasklens.recognition import classifiers  # and timm, which other designs need not wait for

        device = claim()
        train = dataset.read(*inputs.train, device=device)
        classifier = classifiers.build(settings.classifier, train.classes, inputs.weights).to(device)
    baselines = {}
    if inputs.baselines:
        from tasklens.recognition.metrics import mean_metrics

        baselines = {
            name: (prescription.read(path)[0].lens, mean_metrics(inputs.metrics[name])["minival_accuracy"])
            for name, path in inputs.baselines.items()
        }
    lens, notes, history = methods.design(settings, classifier, train, baselines, checkpoint)
    write_rows(outputs.history, history)
    prescription.write(outputs.lens, prescription.Prescription(lens), notes)
