"""Photographs of a user's folder: those for a design, those that test lenses, and those that are left for a verdict."""

from pathlib import Path

import torch

from tasklens.recognition import class_folders, folders
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.files import FileError

SIZE = 224  # side to which photographs of a folder are resized, unless another is given [pixels]
MAX_IMAGES = 2000  # largest number of images of a folder or a data set for a design
_UNUSED, _LEAST = 500, 20  # largest and smallest number of photographs for a verdict


def of_folder(split: Path, size: int, start: int, limit: int) -> ImageDataset:
    """Read at most `limit` photographs <split>/<class>/*, from index `start` of their random order.

    Raises:
        FileError: as in `folders.find` and `folders.read_all`.
    """
    listing = folders.find(split, start + limit, 0)
    listing = listing.take(torch.arange(len(listing))[start:])
    return ImageDataset(folders.read_all(listing.files, size), listing.labels, listing.classes)


def test_images(folder: Path, size: int, limit: int) -> ImageDataset:
    """Read at most `limit` test photographs of a folder: test/<class>/* (or val), or <class>/*; raises FileError."""
    return of_folder(class_folders.test_folder(folder), size, 0, limit)


def training_count(folder: Path, held_out: bool) -> int:
    """Return the number of photographs for a design: four fifths of a folder without splits if some are held out."""
    if not held_out or class_folders.is_split(folder):
        return MAX_IMAGES
    return max(1, 4 * class_folders.count(folder, MAX_IMAGES * 5 // 4) // 5)


def unused_images(folder: Path, size: int | None) -> ImageDataset:
    """Return at most 500 photographs that a design with baselines does not use; raises FileError for fewer than 20."""
    size = SIZE if size is None else size
    if class_folders.is_split(folder):
        images = test_images(folder, size, _UNUSED)
        class_folders.same_classes(folder, class_folders.training_classes(folder), images.classes)
    else:
        images = of_folder(folder, size, training_count(folder, held_out=True), _UNUSED)
    if len(images) < _LEAST:
        raise FileError(
            f"{folder}: {len(images)} photographs are left for a verdict on the lens; expected {_LEAST} or more (a "
            "fifth of <class>/*, or test/<class>/*); add some, or use --no-verdict"
        )
    return images
