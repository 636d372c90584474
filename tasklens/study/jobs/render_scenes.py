"""Rendering or import of the images with objects."""

import sys
from pathlib import Path

from tasklens.recognition import coco, object_scenes, objects
from tasklens.recognition.objects import ObjectDataset
from tasklens.runtime.files import FileError
from tasklens.settings.task_settings import SceneSettings


def run(
    scenes: SceneSettings, source: str | None, train: Path, train_objects: Path, test: Path, test_objects: Path
) -> None:
    """Write images and objects of both splits; `source` is the digest of their folder, if they have one."""
    paths = {"train": (train, train_objects), "test": (test, test_objects)}
    for name, split in splits(scenes).items():
        objects.write(split, *paths[name])
        print(f"{name}: {len(split)} images with {len(split.owner)} objects", file=sys.stderr)


def splits(settings: SceneSettings) -> dict[str, ObjectDataset]:
    """Return the splits `train` and `test`: rendered, or read from a folder in COCO format.

    Raises:
        FileError: as in `coco.read`, or the splits have different classes.
    """
    counts = {"train": settings.train, "test": settings.test}
    if settings.folder is None:
        return {
            name: object_scenes.render(count, settings.size, 2 * settings.seed + k, settings.periods)
            for k, (name, count) in enumerate(counts.items())
        }
    read = {
        name: coco.read(settings.folder, split, settings.size, counts[name], settings.seed)
        for name, split in coco.split_names(settings.folder).items()
    }
    if read["train"].classes != read["test"].classes:
        differences = set(read["train"].classes) ^ set(read["test"].classes)
        raise FileError(f"{settings.folder}: training and test annotations differ in {', '.join(sorted(differences))}")
    return read
