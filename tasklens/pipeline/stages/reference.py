"""Training of a classifier on the sharp images, or its published weights."""

import torch

from tasklens.recognition import classifiers, dataset, training
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_tensors
from tasklens.study.settings import ClassifierSettings


def run(settings: ClassifierSettings, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the weights."""
    device = claim()
    train = dataset.read(*inputs.train, device=device)
    torch.manual_seed(settings.seed)
    classifier = classifiers.build(settings, train.classes).to(device)
    if settings.training is not None:
        training.fit(
            {settings.model: classifier}, train, settings.training, settings.seed, "reference", checkpoint=checkpoint
        )
    write_tensors(outputs.weights, classifier.network.state_dict(), {"model": settings.model})
