"""Rendering or import of the images, split into train, minival and test."""

import sys
from pathlib import Path

from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.settings.image_settings import ImageSettings


def run(
    images: ImageSettings,
    source: str | None,
    train: Path,
    train_labels: Path,
    minival: Path,
    minival_labels: Path,
    test: Path,
    test_labels: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write images and labels of the three splits; `source` is the digest of their folder, if they have one."""
    paths = {"train": (train, train_labels), "minival": (minival, minival_labels), "test": (test, test_labels)}
    dataset.make(images, paths, checkpoint)
    for name, files in paths.items():
        split = dataset.read(*files)
        print(f"{name}: {len(split)} images of {len(split.classes)} classes", file=sys.stderr)
