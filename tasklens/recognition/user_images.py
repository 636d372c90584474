"""Images of a user in Python: a file or any common array type; labelled, a torch data set or any sequence of pairs."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy
import torch
from PIL.Image import Image as PillowImage
from torch import Tensor
from torch.utils.data import DataLoader

from tasklens.recognition import class_folders, folders
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.folders import read_whole, rgb
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.runtime.tensors import NO_VALUES, as_tensor

SIZE = 224  # side to which photographs of a folder are resized, unless another is given [pixels]
Image = str | Path | PillowImage | numpy.ndarray | Tensor
_ROUNDING = 1e-6  # tolerance of floats in [0, 1]


def of_pairs(pairs: Any, limit: int | None = None) -> ImageDataset:
    """Return a data set from pairs (image, label) of any length, as torch's data sets have them.

    `image_tensor` converts each image; all must have the same size, and are stored as 8 bits. A label is an integer
    from 0, or a number or tensor for a custom loss. Class names come from `pairs.classes`, also behind torch's
    `Subset`, or are the labels.

    Args:
        limit: largest number of images of a data set of known length, drawn at random; None: all.

    Raises:
        InputError: there are no pairs, image sizes differ, or an image cannot be read (the message has its index).
    """
    if isinstance(pairs, ImageDataset):
        return pairs
    images, labels = [], []
    for number, pair in _items(pairs, limit):
        try:
            image, label = pair
            images.append((255 * image_tensor(image)).round().byte())
            labels.append(_label(label))
        except (InputError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(f"images: number {number}: expected a pair (image, label): {error}") from None
    if not images:
        raise InputError("images: expected pairs (image, label), got none")
    if len(sizes := {tuple(image.shape) for image in images}) > 1:
        raise InputError(f"images: expected one size, got {', '.join(map(str, sorted(sizes)))}; resize them")
    if len(shapes := {tuple(label.shape) for label in labels}) > 1:
        raise InputError(f"images: expected labels of one shape, got {', '.join(map(str, sorted(shapes)))}")
    numbers = torch.stack(labels)
    names: Iterable[Any] | None = _classes(pairs)
    if names is None:
        names = () if numbers.is_floating_point() else range(int(numbers.max()) + 1)
    return ImageDataset(torch.stack(images), numbers, tuple(map(str, names)))


def _label(label: Any) -> Tensor:
    """Return a label as a tensor; a whole number as int64, of whatever type it is."""
    tensor = as_tensor(label, "label")
    is_whole = tensor.dim() == 0 and not tensor.is_floating_point() and tensor.dtype != torch.bool
    return tensor.long() if is_whole else tensor


def check_classes(dataset: ImageDataset) -> None:
    """Raise InputError if labels are not numbers of the classes of a data set."""
    labels = dataset.labels
    kind = f"{labels.dtype} of shape {tuple(labels.shape[1:])}" if labels.dim() > 1 else f"{labels.dtype}"
    if labels.dim() != 1 or labels.is_floating_point() or labels.dtype == torch.bool:
        raise InputError(
            f"images: expected labels that are numbers of classes, integers from 0, got {kind}; a design takes others "
            "with a `loss`"
        )
    if labels.min() < 0:
        raise InputError(f"images: expected labels that are numbers of classes, from 0, got {int(labels.min())}")
    if labels.max() >= len(dataset.classes):
        raise InputError(
            f"images: expected labels from 0 to {len(dataset.classes) - 1}, numbers of {len(dataset.classes)} classes, "
            f"got {int(labels.min())} to {int(labels.max())}"
        )


def _classes(pairs: Any) -> Sequence[str] | None:
    """Return the names of the classes of a data set, or of the data set that it is a part of; None without names."""
    while not hasattr(pairs, "classes") and hasattr(pairs, "dataset"):
        pairs = pairs.dataset
    return getattr(pairs, "classes", None)


def _items(pairs: Any, limit: int | None) -> Iterable[tuple[int, Any]]:
    """Return items of a data set with their indices; a torch data set need not be iterable."""
    if hasattr(pairs, "read"):
        raise InputError(f"images: expected a folder, or pairs (image, label), got a file, {type(pairs).__name__}")
    if isinstance(pairs, DataLoader):
        raise InputError("images: expected a data set, got a DataLoader; give its `.dataset`")
    if hasattr(pairs, "__len__") and hasattr(pairs, "__getitem__"):
        indices: Sequence[int] = range(len(pairs))
        if limit is not None and len(pairs) > limit:
            indices = torch.randperm(len(pairs), generator=torch.Generator().manual_seed(0))[:limit].tolist()
        return ((k, pairs[k]) for k in indices)
    if not isinstance(pairs, Iterable):
        raise InputError(f"images: expected a folder, or pairs (image, label), got {type(pairs).__name__}")
    return enumerate(pairs)


def of_folder(split: Path, size: int, start: int, limit: int) -> ImageDataset:
    """Read at most `limit` photographs <split>/<class>/*, from index `start` of their random order.

    Raises:
        FileError: as in `folders.find` and `folders.read`.
    """
    listing = folders.find(split, start + limit, 0)
    listing = listing.take(torch.arange(len(listing))[start:])
    return ImageDataset(folders.read_all(listing.files, size), listing.labels, listing.classes)


def test_images(folder: Path, size: int, limit: int) -> ImageDataset:
    """Read at most `limit` test photographs of a folder: test/<class>/* (or val), or <class>/*; raises FileError."""
    return of_folder(class_folders.test_folder(folder), size, 0, limit)


def image_tensor(image: Image) -> Tensor:
    """Return an image as a tensor (3, H, W) in [0, 1]; raises InputError."""
    if isinstance(image, str | Path):
        if not Path(image).is_file():
            raise FileError(f"{image}: no such image")
        return read_whole(Path(image)).float() / 255
    if not isinstance(image, Tensor):
        if hasattr(image, "read"):
            raise InputError(
                "image: expected the path of a file, a Pillow image, an array or a tensor, got an open file, "
                f"{type(image).__name__}; give PIL.Image.open(file)"
            )
        try:
            array = numpy.array(rgb(image) if isinstance(image, PillowImage) else image)
        except ValueError as error:
            raise InputError(f"image: {error}") from None
        if array.dtype.kind == "u" and array.dtype.itemsize == 2:
            array = array / 65535
        tensor = as_tensor(array, "image")
        image = tensor.movedim(-1, 0) if tensor.dim() == 3 else tensor
    if image.is_meta:
        raise InputError(f"image: {NO_VALUES}")
    if image.dim() != 3 or image.shape[0] != 3:
        hint = "; repeat a grey one three times" if image.dim() == 2 or 1 in image.shape[:1] else ""
        raise InputError(f"image: expected an array (H, W, 3) or a tensor (3, H, W), got {tuple(image.shape)}{hint}")
    if image.dtype in (torch.uint8, torch.uint16):
        return image.float() / torch.iinfo(image.dtype).max
    if not image.is_floating_point():
        raise InputError(f"image: expected uint8, uint16 or floats in [0, 1], got {image.dtype}")
    low, high = float(image.detach().min()), float(image.detach().max())
    if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
        advice = "scale them, or convert to uint8" if low >= 0 else "normalise in the network, not before the lens"
        raise InputError(f"image: expected floats in [0, 1], got {low:g} to {high:g}; {advice}")
    return image.float()
