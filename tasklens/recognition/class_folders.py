"""Folders of photographs with one folder per class: their contents, and checks of the counts. Does not import torch.

Hidden files and folders (names that begin with a dot) are skipped: macOS and Jupyter leave copies in them.
"""

import os
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from tasklens.runtime.files import FileError
from tasklens.study.settings import ImageSettings

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
OTHERS = (".tif", ".tiff", ".bmp", ".gif", ".heic", ".jp2", ".avif", ".dng")  # image formats that are not supported
TRAIN, TEST = ("train",), ("test", "val")  # possible folder names of each split


def is_split(folder: Path) -> bool:
    """Return whether a folder has separate train and test folders; if not, it contains the class folders."""
    if not folder.is_dir():
        return True  # its reader reports that it is missing
    inside = {entry.name for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")}
    return not inside or bool(inside & {*TRAIN, *TEST})


def split_folder(folder: Path, names: Sequence[str]) -> Path:
    """Return the first folder in `names` that exists in `folder`; raises FileError if none does."""
    if not folder.is_dir():
        raise FileError(f"images.folder = {folder}: no such folder; correct the path")
    split = next((folder / name for name in names if (folder / name).is_dir()), None)
    if split is None:
        raise FileError(f"images.folder = {folder}: expected a folder {' or '.join(names)} in it, a folder per class")
    return split


def classes(split: Path) -> list[str]:
    """Return the names of the class folders in a split, in class order.

    Raises:
        FileError: there is no class folder, or two names differ only in how Unicode composes their letters.
    """
    inside = [entry.name for entry in split.iterdir() if entry.is_dir() and not entry.name.startswith(".")]
    if not inside:
        raise FileError(f"{split}: expected a folder per class in it, found none")
    if len(inside) > len({composed(name) for name in inside}):
        duplicate = next(name for name in inside if sum(composed(name) == composed(other) for other in inside) > 1)
        raise FileError(f"{split}: two folders are called {duplicate}, with letters composed in two ways; merge them")
    return sorted(inside, key=composed)


def composed(name: str) -> str:
    """Return a name in composed Unicode (NFC), which most systems use; macOS decomposes letters."""
    return unicodedata.normalize("NFC", name)


def training_classes(folder: Path) -> list[str]:
    """Return the names of the classes of the training images; raises FileError."""
    return classes(split_folder(folder, TRAIN) if is_split(folder) else folder)


def photographs(folder: Path) -> Iterator[Path]:
    """Yield the photographs of a class lazily, in no particular order, so that reading a few is cheap.

    Raises:
        FileError: an image has an unsupported format or is not a regular file.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_dir(follow_symlinks=False):
                yield from photographs(Path(entry.path))
            elif entry.name.lower().endswith(SUFFIXES):
                if not entry.is_file():  # reading a pipe would block forever
                    raise FileError(f"{entry.path}: a pipe, a folder or a link to nothing; remove it")
                yield Path(entry.path)
            elif entry.name.lower().endswith(OTHERS):
                raise FileError(f"{entry.path}: expected {', '.join(SUFFIXES)}; convert it, or remove it")


def no_image(folder: Path) -> FileError:
    """Return the error for a class without photographs."""
    return FileError(f"{folder}: this class has no image ({', '.join(SUFFIXES)}); add some, or remove the folder")


def same_classes(folder: Path, train: Sequence[str], test: Sequence[str]) -> None:
    """Raise FileError if the classes of two splits differ."""
    if differences := sorted(set(map(composed, train)) ^ set(map(composed, test))):
        raise FileError(f"{folder}: train and test have different classes: {', '.join(differences)}")


def check(images: ImageSettings) -> None:
    """Check that every class has an image and that there are enough for the minival, without listing all images.

    Raises:
        FileError: the message names the folder, the expected and the actual contents.
    """
    if images.folder is None:
        return
    if images.folder.is_dir() and not is_split(images.folder):
        _check_whole(images, images.folder)
        return
    splits = [split_folder(images.folder, names) for names in (TRAIN, TEST)]
    train, test = (classes(split) for split in splits)
    same_classes(images.folder, train, test)
    if len(train) < 2:
        raise FileError(f"{splits[0]}: expected two classes or more, a folder each, found only {train[0]}")
    for split in splits:
        for name in classes(split):
            if next(photographs(split / name), None) is None:
                raise no_image(split / name)
    minimum = images.minival + 1
    if (total := count(splits[0], minimum)) < minimum:
        raise too_few(images, total)
    requests = {"train and minival": (images.train or 0) + images.minival, "test": images.test or 0}
    for split, (keys, request) in zip(splits, requests.items(), strict=True):
        if (total := count(split, request)) < request:
            raise FileError(
                f"{split}: has {total} images, {keys} of `images` ask for {request}; ask for fewer, or null for all"
            )


def _check_whole(images: ImageSettings, folder: Path) -> None:
    """Check a folder of classes that will be split into test, minival and training images; raises FileError."""
    if len(names := classes(folder)) < 2:
        raise FileError(f"{folder}: expected two classes or more, a folder each, found only {names[0]}")
    if images.train is None and images.test is None:
        raise FileError(
            f"images.folder = {folder}: has neither train nor test; set images.test or images.train to the number of "
            "photographs for it"
        )
    for name in names:
        if next(photographs(folder / name), None) is None:
            raise no_image(folder / name)
    minimum = (images.test or 1) + images.minival + (images.train or 1)
    if (total := count(folder, minimum)) < minimum:
        raise FileError(f"{folder}: has {total} images; test, minival and train of `images` ask for {minimum}")


def count(split: Path, most: int) -> int:
    """Count the photographs in the folder of a split, up to `most`."""
    return sum(1 for _ in islice((file for name in classes(split) for file in photographs(split / name)), most))


def too_few(images: ImageSettings, total: int) -> FileError:
    """Return the error for a folder with too few training images."""
    return FileError(
        f"images.minival = {images.minival}: expected fewer than the {total} training images it is cut from"
    )
