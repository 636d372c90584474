"""Training of a classifier on sharp images, or import of its published weights."""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from tasklens.recognition import classifiers, dataset, sharp, training
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_tensors
from tasklens.settings.network_settings import ClassifierSettings

_SHARP, _ENOUGH = 500, 30  # maximum and minimum number of images to check published weights


def run(
    settings: ClassifierSettings, images: Sequence[Path], published: Path | None, weights: Path, checkpoint: Checkpoint
) -> None:
    """Train the classifier or load its published weights, and write the weights.

    Args:
        images: training images and their labels.
        published: file of the published weights; `settings` has its path, and the rule waits for it.
    """
    device = claim()
    train = dataset.read(*images, device=device)
    torch.manual_seed(settings.seed)
    classifier = classifiers.build(settings, train.classes).to(device)
    if settings.training is not None and settings.training.epochs:
        training.fit(classifier, train, settings.training, settings.seed, "reference", checkpoint=checkpoint)
    elif len(train) >= _ENOUGH:
        order = torch.randperm(len(train), generator=torch.Generator().manual_seed(0))[:_SHARP]
        print(sharp.check_accuracy(classifiers.frozen(classifier, train.images), train.take(order)), file=sys.stderr)
    write_tensors(weights, classifier.network.state_dict(), {"model": settings.model})
