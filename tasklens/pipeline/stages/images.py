"""Rendering or reading of the images, split into train, minival and test."""

import sys

from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.files import Files
from tasklens.study.names import SPLITS
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the three splits."""
    paths = {name: (getattr(outputs, name), getattr(outputs, f"{name}_labels")) for name in SPLITS}
    dataset.make(settings.images, paths, checkpoint)
    for name, files in paths.items():
        split = dataset.read(*files)
        print(f"{name}: {len(split)} images of {len(split.classes)} classes", file=sys.stderr)
