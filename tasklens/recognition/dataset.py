"""Labelled uint8 images, rendered or from folders: for training, the choice of lenses (minival), tests and verdicts."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from tasklens.recognition import class_folders, folders
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import CPU, send, single_thread
from tasklens.runtime.files import FileError, damage_error, map_array, read_json, write_text, writing_array
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.names import SPLITS

PHOTOGRAPH_SIZE = 224  # side to which photographs of a folder are resized, unless another is given [pixels]
MAX_IMAGES = 2000  # largest number of images of a folder or a data set for a design
_UNUSED, _LEAST = 500, 20  # largest and smallest number of photographs for a verdict


@dataclass(frozen=True)
class ImageDataset:
    """Images (N, 3, H, W) uint8, labels (N,) int64, names of the classes, and the device of batches."""

    images: Tensor
    labels: Tensor
    classes: tuple[str, ...]
    device: torch.device = CPU

    def __len__(self) -> int:
        return len(self.labels)

    def batch(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Return images (B, 3, H, W) in [0, 1], float32, and their labels (B,), on the device."""
        return send(self.images[indices], self.device).float() / 255, send(self.labels[indices], self.device)

    def take(self, indices: Tensor) -> "ImageDataset":
        """Return the subset of images with these indices."""
        return replace(self, images=self.images[indices], labels=self.labels[indices])


Paths = tuple[Path, Path]  # files of the images and of the labels of a split


def make(images: ImageSettings, paths: Mapping[str, Paths], checkpoint: Checkpoint = NO_CHECKPOINT) -> None:
    """Write the splits train, minival and test; the minival is taken from the training images.

    Photographs are decoded by as many threads as torch may use.

    Args:
        paths: files by split.
        checkpoint: checkpoint of the job.

    Raises:
        FileError: a folder is missing, a class is empty, an image is unreadable, or there are too few images.
    """
    temporary_files = {path: path.with_name(f".{path.name}") for path, _ in paths.values()}
    listings: dict[Path, folders.Listing] = {}
    try:
        for name, split in zip(SPLITS, _splits(images), strict=True):
            path, labels = paths[name]
            if isinstance(split, ImageDataset):
                temporary_files[path].unlink(missing_ok=True)  # of a killed job with photographs
                write(split, path, labels)
            else:  # in temporary files, since Snakemake deletes the outputs of a killed job
                folders.convert(split, images.size, temporary_files[path], torch.get_num_threads(), checkpoint)
                listings[labels] = split
    except Exception:
        for temporary in temporary_files.values():
            temporary.unlink(missing_ok=True)
        raise
    for labels, listing in listings.items():
        _write_labels(listing, labels)
    for path, temporary in temporary_files.items():
        if temporary.exists():
            temporary.replace(path)


def _splits(images: ImageSettings) -> tuple[ImageDataset | folders.Listing, ...]:
    """Return train, minival and test, as rendered images or as listings of photographs."""
    pool: ImageDataset | folders.Listing
    test: ImageDataset | folders.Listing
    if images.folder is None:
        assert images.train is not None and images.test is not None  # rendered images need counts
        pool = _render(images.train + images.minival, 2 * images.seed, images)
        test = _render(images.test, 2 * images.seed + 1, images)
    elif not class_folders.is_split(images.folder):
        return _cut(images, folders.find(images.folder, None, images.seed))
    else:
        limit = None if images.train is None else images.train + images.minival
        pool = folders.find(class_folders.train_folder(images.folder), limit, images.seed)
        test = folders.find(class_folders.test_folder(images.folder), images.test, images.seed)
        class_folders.same_classes(images.folder, pool.classes, test.classes)
    if len(pool) <= images.minival:
        raise class_folders.too_few(images, len(pool))
    order = torch.randperm(len(pool), generator=torch.Generator().manual_seed(images.seed))
    return pool.take(order[images.minival :]), pool.take(order[: images.minival]), test


def _cut(images: ImageSettings, photographs: folders.Listing) -> tuple[folders.Listing, ...]:
    """Split photographs into train, minival and test, each with the classes in proportion."""
    rest = len(photographs) - images.minival
    test = images.test if images.test is not None else rest - (images.train or 0)
    train = images.train if images.train is not None else rest - test
    if min(test, train) < 1 or test + train > rest:
        raise FileError(
            f"{images.folder}: has {len(photographs)} images; test, minival and train of `images` ask for {test}, "
            f"{images.minival} and {train}"
        )
    order, rest = torch.arange(len(photographs)), test + images.minival
    parts = order[rest : rest + train], order[test:rest], order[:test]
    return tuple(map(photographs.take, parts))


def training_images(images: ImageSettings, path: Path, *, device: torch.device = CPU) -> ImageDataset:
    """Return only the training images; in a folder, from folder/train/<class> or folder/<class>.

    Args:
        path: the .npy file to which photographs are converted.

    Raises:
        FileError: a folder is missing, a class is empty, or an image is unreadable.
    """
    if images.folder is None:
        assert images.train is not None  # rendered images need counts
        return replace(_render(images.train, 2 * images.seed, images), device=device)
    listing = folders.find(class_folders.train_folder(images.folder), images.train, images.seed, least=1)
    folders.convert(listing, images.size, path, torch.get_num_threads())
    return ImageDataset(map_array(path), listing.labels, listing.classes, device)


def _of_folder(split: Path, size: int, start: int, limit: int) -> ImageDataset:
    """Read at most `limit` photographs <split>/<class>/*, from index `start` of their random order.

    Raises:
        FileError: as in `folders.find` and `folders.read_all`.
    """
    listing = folders.find(split, start + limit, 0)
    listing = listing.take(torch.arange(len(listing))[start:])
    return ImageDataset(folders.read_all(listing.files, size), listing.labels, listing.classes)


def test_images(folder: Path, size: int, limit: int) -> ImageDataset:
    """Read at most `limit` test photographs of a folder: test/<class>/* (or val), or <class>/*; raises FileError."""
    return _of_folder(class_folders.test_folder(folder), size, 0, limit)


def training_count(folder: Path, held_out: bool) -> int:
    """Return the number of photographs for a design: four fifths of a folder without splits if some are held out."""
    if not held_out or class_folders.is_split(folder):
        return MAX_IMAGES
    return max(1, 4 * class_folders.count(folder, MAX_IMAGES * 5 // 4) // 5)


def unused_images(folder: Path, size: int | None) -> ImageDataset:
    """Return at most 500 photographs that a design with baselines does not use; raises FileError for fewer than 20."""
    size = PHOTOGRAPH_SIZE if size is None else size
    if class_folders.is_split(folder):
        images = test_images(folder, size, _UNUSED)
        class_folders.same_classes(folder, class_folders.training_classes(folder), images.classes)
    else:
        images = _of_folder(folder, size, training_count(folder, held_out=True), _UNUSED)
    if len(images) < _LEAST:
        raise FileError(
            f"{folder}: {len(images)} photographs are left for a verdict on the lens; expected {_LEAST} or more (a "
            "fifth of <class>/*, or test/<class>/*); add some, or use --no-verdict"
        )
    return images


def _render(count: int, seed: int, images: ImageSettings) -> ImageDataset:
    from tasklens.recognition import scenes

    with single_thread():  # the same images on any number of cores
        return ImageDataset(*scenes.render(count, images.size, seed, images.periods), scenes.CLASSES)


def write(dataset: ImageDataset, images: Path, labels: Path) -> None:
    """Write a split: images as .npy (N, 3, H, W) uint8, labels and names of the classes as JSON."""
    with writing_array(images, tuple(dataset.images.shape)) as array:
        array[:] = dataset.images.numpy()
    _write_labels(dataset, labels)


def _write_labels(split: ImageDataset | folders.Listing, path: Path) -> None:
    """Write the names of the classes and the labels, and the files of photographs, all in the order of the images."""
    content = {"classes": list(split.classes), "labels": split.labels.tolist()}
    if isinstance(split, folders.Listing):
        content["files"] = [str(file) for file in split.files]
    write_text(path, json.dumps(content) + "\n")


def read(images: Path, labels: Path, *, device: torch.device = CPU) -> ImageDataset:
    """Read a split written by `make`; images are memory-mapped, not copied.

    Raises:
        FileError: a file is incomplete, or the numbers of images and labels differ.
    """
    array = map_array(images)
    content = read_json(labels)
    try:
        label_tensor = torch.tensor(content["labels"], dtype=torch.long)
        classes = tuple(content["classes"])
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise damage_error(labels, f"no labels of images ({error})") from error
    if len(array) != len(label_tensor):
        raise FileError(f"{labels}: {len(label_tensor)} labels for the {len(array)} images of {images}; remove both")
    return ImageDataset(array, label_tensor, classes, device)
