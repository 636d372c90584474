"""Rendering or import of the images with objects."""

import sys
from pathlib import Path

from tasklens.recognition import object_splits, objects
from tasklens.study.task_jobs import ScenesJob


def run(settings: ScenesJob, train: Path, train_objects: Path, test: Path, test_objects: Path) -> None:
    """Write images and objects of both splits."""
    paths = {"train": (train, train_objects), "test": (test, test_objects)}
    for name, split in object_splits.make(settings.scenes).items():
        objects.write(split, *paths[name])
        print(f"{name}: {len(split)} images with {len(split.owner)} objects", file=sys.stderr)
