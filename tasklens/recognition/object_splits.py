"""Training and test images with objects: rendered, or read from a folder in COCO format."""

from pathlib import Path

from tasklens.recognition import coco, object_scenes
from tasklens.recognition.objects import ObjectDataset
from tasklens.runtime.files import FileError
from tasklens.settings.task_settings import SceneSettings

_NAMES = {"train": ("train2017", "train"), "test": ("val2017", "val")}  # possible names of a folder's splits


def check(settings: SceneSettings) -> None:
    """Check that a folder has annotations of both splits; raises FileError."""
    if settings.folder is not None:
        for names in _NAMES.values():
            _split(settings.folder, names)


def make(settings: SceneSettings) -> dict[str, ObjectDataset]:
    """Return the splits `train` and `test`.

    Raises:
        FileError: as in `coco.read`, or the splits have different classes.
    """
    counts = {"train": settings.train, "test": settings.test}
    if settings.folder is None:
        return {
            name: object_scenes.render(count, settings.size, 2 * settings.seed + k, settings.periods)
            for k, (name, count) in enumerate(counts.items())
        }
    splits = {
        name: coco.read(settings.folder, _split(settings.folder, names), settings.size, counts[name], settings.seed)
        for name, names in _NAMES.items()
    }
    if splits["train"].classes != splits["test"].classes:
        differences = set(splits["train"].classes) ^ set(splits["test"].classes)
        raise FileError(f"{settings.folder}: training and test annotations differ in {', '.join(sorted(differences))}")
    return splits


def _split(folder: Path, names: tuple[str, ...]) -> str:
    """Return the first name in `names` that has annotations; raises FileError if none has."""
    for name in names:
        if (folder / "annotations" / f"instances_{name}.json").exists():
            return name
    raise FileError(f"{folder}: has no annotations/instances_{names[0]}.json, nor instances_{names[1]}.json")
