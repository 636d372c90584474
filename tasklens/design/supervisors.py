"""Images and network that supervise the designs of a study."""

import sys
from pathlib import Path

import torch
from torch import nn

from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.devices import claim
from tasklens.study.study import Study

_SHARP = 500  # images that show what the network recognises, at most


def supervisors(study: Study, folder: Path) -> tuple[ImageDataset | None, nn.Module | None]:
    """Return the images and the network that designs of the study need; images are converted to a file in `folder`."""
    entries = study.lenses.values()
    if not any(entry.supervised for entry in entries):
        return None, None
    from tasklens.recognition import classifiers, dataset, sharp

    settings = study.classifier(study.supervisor)
    if any(entry.classified for entry in entries):
        classifiers.check(study.supervisor, settings, study.images.size)
    device = claim()
    images = dataset.training_images(study.images, folder / "images.npy", device=device)
    if not any(entry.classified for entry in entries):
        return images, None
    torch.manual_seed(0)
    network = classifiers.build(settings, images.classes).to(device)
    shown = images.take(torch.randperm(len(images), generator=torch.Generator().manual_seed(0))[:_SHARP])
    print(f"tasklens: {sharp.recognised(classifiers.frozen(network, images.images), shown)}", file=sys.stderr)
    return images, network
