"""Labelled images of a user in Python: a torch data set, or any sequence of pairs (image, label)."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.image_tensors import image_tensor
from tasklens.runtime.errors import InputError
from tasklens.runtime.tensors import as_tensor


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
