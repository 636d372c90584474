"""Rendering or import of the images with objects."""

import sys
from pathlib import Path

from tasklens.recognition import object_splits, objects
from tasklens.settings.task_settings import SceneSettings


def run(
    scenes: SceneSettings, source: str | None, train: Path, train_objects: Path, test: Path, test_objects: Path
) -> None:
    """Write images and objects of both splits; `source` is the digest of their folder, if they have one."""
    paths = {"train": (train, train_objects), "test": (test, test_objects)}
    for name, split in object_splits.make(scenes).items():
        objects.write(split, *paths[name])
        print(f"{name}: {len(split)} images with {len(split.owner)} objects", file=sys.stderr)
