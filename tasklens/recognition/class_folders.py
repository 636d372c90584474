"""Folders of photographs with one folder per class: their contents, and checks of the counts. Does not import torch.

The classes are in the folder itself, or in two splits, `train` and `test`. Links are followed. Hidden files and folders
(names that begin with a dot) are skipped: macOS and Jupyter leave copies in them.
"""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import ImageSettings

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp")
OTHERS = (".tif", ".tiff", ".bmp", ".gif", ".heic", ".jp2", ".avif", ".dng")  # image formats that are not supported
_TRAIN = ("train", "training")  # names of each split in any case, the preferred one first
_TEST = ("test", "testing", "val", "valid", "validation")
_ENDING = re.compile(r"[-_ .]?(set|images|imgs|data|split|\d+)$")  # as in test_set or val2017


def is_split(folder: Path) -> bool:
    """Return whether a folder has separate train and test folders; if not, it contains the class folders.

    A folder with the name of one split alone, beside others, may be a class such as train, beside car; it is a split
    if it has folders inside.
    """
    if not folder.is_dir():
        return True  # its reader reports that it is missing
    names = _subfolders(folder)
    train, test = _find_split(folder, names, _TRAIN), _find_split(folder, names, _TEST)
    if not names or (train and test):
        return True
    only = train or test
    return only is not None and (
        all(_ENDING.sub("", name.casefold()) in (*_TRAIN, *_TEST) for name in names) or bool(_subfolders(folder / only))
    )


def train_folder(folder: Path) -> Path:
    """Return the folder of the classes for training: a split, or the folder itself; raises FileError."""
    return _split_folder(folder, _TRAIN)


def test_folder(folder: Path) -> Path:
    """Return the folder of the classes for tests: a split, or the folder itself; raises FileError."""
    return _split_folder(folder, _TEST)


def _split_folder(folder: Path, names: Sequence[str]) -> Path:
    if not folder.is_dir():
        raise FileError(f"images.folder = {folder}: no such folder of images; correct the path")
    if not is_split(folder):
        return folder
    if (name := _find_split(folder, _subfolders(folder), names)) is None:
        usual = "train" if names == _TRAIN else "test or val"
        raise FileError(f"images.folder = {folder}: expected a folder {usual} in it, a folder per class")
    return folder / name


def _subfolders(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return [entry.name for entry in entries if not entry.name.startswith(".") and _is_folder(entry)]


def _is_folder(entry: "os.DirEntry[str]") -> bool:
    """Return whether an entry is a folder or a link to one; `is_dir` raises OSError for a link to itself."""
    return entry.is_dir(follow_symlinks=False) or (entry.is_symlink() and os.path.isdir(entry.path))


def _find_split(folder: Path, names: Sequence[str], spellings: Sequence[str]) -> str | None:
    """Return the name of a split in any case, by the first of its spellings that occurs; raises FileError for two.

    A word or number may follow it, as in test_set or val2017.
    """
    for spelling in spellings:
        same = sorted(name for name in names if _ENDING.sub("", name.casefold()) == spelling)
        if len(same) > 1:
            raise FileError(f"{folder}: {' and '.join(same)} have the name of one split; merge them, or rename one")
        if same:
            return same[0]
    return None


def classes(split: Path, least: int = 2) -> list[str]:
    """Return the names of the class folders in a split, in class order.

    Args:
        least: smallest number of classes.

    Raises:
        FileError: there are fewer, a class has splits in turn, or two names differ only in how Unicode composes their
            letters.
    """
    inside = _subfolders(split)
    if not inside:
        raise FileError(f"{split}: expected a folder per class in it, found none")
    if deeper := next((name for name in sorted(inside) if _has_splits(split / name)), None):
        raise FileError(f"{split}: expected a folder per class, but {deeper} has train and test; give {split / deeper}")
    if len(inside) < least:
        advice = f"; if its folders are the classes, give {split / inside[0]}" * bool(_subfolders(split / inside[0]))
        raise FileError(f"{split}: expected two classes or more, a folder each, found only {inside[0]}{advice}")
    links = sorted(name for name in inside if (split / name).is_symlink())
    classes_at: dict[Path, str] = {}
    for name in [*sorted({*inside} - {*links}), *links] if links else []:
        if (same := classes_at.setdefault((split / name).resolve(), name)) != name:
            raise FileError(f"{split}: {name} is a link to the folder of the class {same}; remove it")
    if len(inside) > len({compose_letters(name) for name in inside}):
        duplicate = next(
            name for name in inside if sum(compose_letters(name) == compose_letters(other) for other in inside) > 1
        )
        raise FileError(f"{split}: two folders are called {duplicate}, with letters composed in two ways; merge them")
    return sorted(inside, key=compose_letters)


def _has_splits(folder: Path) -> bool:
    """Return whether a folder has two splits with folders of classes, without listing its photographs."""

    def has_split(spellings: Sequence[str]) -> bool:
        paths = (folder / name for spelling in spellings for name in (spelling, spelling.title(), spelling.upper()))
        return any(path.is_dir() and bool(_subfolders(path)) for path in paths)

    return has_split(_TRAIN) and has_split(_TEST)


def compose_letters(name: str) -> str:
    """Return a name in composed Unicode (NFC), which most systems use; macOS decomposes letters."""
    return unicodedata.normalize("NFC", name)


def training_classes(folder: Path) -> list[str]:
    """Return the names of the classes of the training images; raises FileError."""
    return classes(train_folder(folder))


def photographs(folder: Path) -> Iterator[Path]:
    """Yield the photographs of a class lazily, in no particular order, so that reading a few is cheap.

    Raises:
        FileError: an image has an unsupported format or is not a regular file.
    """
    return (path for path, kind in _entries(folder) if not kind)


def contents(folder: Path) -> tuple[list[Path], Counter[str]]:
    """Return the photographs of a class in order, and the number of other files by kind; raises as `photographs`."""
    files, others = [], Counter[str]()
    for path, kind in _entries(folder):
        if kind:
            others[kind] += 1
        else:
            files.append(path)
    return sorted(files), others


def beside_classes(split: Path) -> Counter[str]:
    """Return the number of files beside the class folders of a split, by kind, and of folders beside the split."""
    files = [path for path in split.iterdir() if not path.name.startswith(".") and not path.is_dir()]
    kinds = Counter(
        "photographs in no class folder" if path.suffix.lower() in SUFFIXES else _kind(path.name) for path in files
    )
    if is_split(folder := split.parent) and split in (splits := _splits(folder)):
        kinds["folders beside train and test"] += len(_subfolders(folder)) - len(splits)
    return +kinds


def _splits(folder: Path) -> list[Path]:
    """Return the folders of the splits that there are."""
    names = _subfolders(folder)
    spelled = (_find_split(folder, names, spellings) for spellings in (_TRAIN, _TEST))
    return [folder / name for name in spelled if name is not None]


def describe_others(folder: Path, others: Counter[str]) -> str:
    """Return a line with the number of files that are not read, by kind; empty if there are none."""
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(others.items()))
    return counts and f"{folder}: passed over: {counts}"


def folders_inside(split: Path, per_class: Iterable[Sequence[Path]]) -> str:
    """Return a line if every class has all photographs in two folders or more inside, so that these may be the classes.

    Args:
        per_class: photographs of each class.
    """
    inside = [{file.parent for file in files} for files in per_class]
    if any(len(folders) < 2 or any(folder.parent == split for folder in folders) for folders in inside):
        return ""
    example = min(inside[0])
    words = f"its {len(inside)} folders are the classes; if those inside are, such as {example.name}"
    return f"{split}: {words}, give {example.parent}"


def _kind(name: str) -> str:
    return Path(name).suffix.lower() or "without a suffix"


def _entries(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield all files of a class, each with its kind, which is empty for a photograph; raises as `photographs`."""
    class_folder, split = folder.resolve(), folder.parent.resolve()
    seen = {*class_folder.parents, split, *split.parents}  # a link there leads in a circle
    waiting = [folder]
    while waiting:
        here = waiting.pop()
        real = here.resolve()
        if real in seen or (split in real.parents and class_folder not in (real, *real.parents)):
            yield here, "links to folders that are read already"  # or of other classes
            continue
        seen.add(real)
        with os.scandir(here) as entries:
            for entry in entries:
                if entry.name.startswith("."):
                    continue
                path = Path(entry.path)
                if _is_folder(entry):
                    waiting.append(path)
                elif entry.name.lower().endswith(SUFFIXES):
                    if not os.path.isfile(path):  # reading a pipe would block forever
                        raise FileError(f"{path}: a pipe, a folder or a link to nothing; remove it")
                    yield path, ""
                elif entry.name.lower().endswith(OTHERS):
                    raise FileError(f"{path}: expected {', '.join(SUFFIXES)}; convert it, or remove it")
                else:
                    yield path, _kind(entry.name)


def no_image(folder: Path) -> FileError:
    """Return the error for a class without photographs."""
    return FileError(f"{folder}: this class has no image ({', '.join(SUFFIXES)}); add some, or remove the folder")


def same_classes(folder: Path, train: Sequence[str], test: Sequence[str]) -> None:
    """Raise FileError if the classes of two splits differ."""
    if differences := sorted(set(map(compose_letters, train)) ^ set(map(compose_letters, test))):
        raise FileError(f"{folder}: train and test have different classes: {', '.join(differences)}")


def check(images: ImageSettings) -> None:
    """Check that every class has an image and that there are enough for the minival, without listing all images.

    Raises:
        FileError: the message names the folder, the expected and the actual contents.
    """
    if (folder := images.folder) is None:
        return
    splits = [train_folder(folder), test_folder(folder)] if is_split(folder) else [folder]
    if len(splits) == 2:
        same_classes(folder, *(classes(split, 1) for split in splits))
    classes(splits[0])  # two or more
    if len(splits) == 1 and images.train is None and images.test is None:
        raise FileError(
            f"images.folder = {folder}: has neither train nor test; set images.test or images.train to the number of "
            "photographs for it"
        )
    for split in splits:
        for name in classes(split):
            if next(photographs(split / name), None) is None:
                raise no_image(split / name)
    if len(splits) == 1:  # it will be cut into test, minival and training images
        minimum = (images.test or 1) + images.minival + (images.train or 1)
        if (total := count(folder, minimum)) < minimum:
            raise FileError(f"{folder}: has {total} images; test, minival and train of `images` ask for {minimum}")
        return
    minimum = images.minival + 1
    if (total := count(splits[0], minimum)) < minimum:
        raise too_few(images, total)
    requests = {"train and minival": (images.train or 0) + images.minival, "test": images.test or 0}
    for split, (keys, request) in zip(splits, requests.items(), strict=True):
        if (total := count(split, request)) < request:
            raise FileError(
                f"{split}: has {total} images, {keys} of `images` ask for {request}; ask for fewer, or null for all"
            )


def count(split: Path, most: int) -> int:
    """Count the photographs in the folder of a split, up to `most`."""
    return sum(1 for _ in islice((file for name in classes(split, 1) for file in photographs(split / name)), most))


def too_few(images: ImageSettings, total: int) -> FileError:
    """Return the error for a folder with too few training images."""
    return FileError(
        f"images.minival = {images.minival}: expected fewer than the {total} training images it is cut from"
    )
