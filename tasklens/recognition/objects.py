"""Images with the boxes, masks and classes of their objects, for segmentation and detection."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy
import torch
from torch import Tensor

from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.devices import CPU
from tasklens.runtime.files import FileError, damage_error, map_array, read_tensors, write_tensors, writing_array


@dataclass(frozen=True)
class ObjectDataset:
    """Images with objects.

    Attributes:
        images: (N, 3, H, W) uint8.
        owner: (M,) int64 image index of each object, non-decreasing.
        labels: (M,) int64 classes.
        masks: (M, H W / 8) uint8, eight pixels per byte, row by row.
        classes: names of the classes, without the background.
        device: device of batches of `as_images`.
    """

    images: Tensor
    owner: Tensor
    labels: Tensor
    masks: Tensor
    classes: tuple[str, ...]
    device: torch.device = CPU

    def __len__(self) -> int:
        return len(self.images)

    def objects_of(self, image: int) -> tuple[Tensor, Tensor]:
        """Return the labels (K,) of the objects of an image, and their masks (K, H, W) bool."""
        first, last = torch.searchsorted(self.owner, torch.tensor([image, image + 1])).tolist()
        return self.labels[first:last], unpack(self.masks[first:last], self.images.shape[-2:])

    def as_images(self) -> ImageDataset:
        """Return the images without objects; the label of each image is its index."""
        return ImageDataset(self.images, torch.arange(len(self.images)), self.classes, self.device)


def pack(masks: Tensor) -> Tensor:
    """Pack masks (M, H, W) bool into (M, H W / 8) uint8; H W must be a multiple of 8."""
    return torch.from_numpy(numpy.packbits(masks.numpy().reshape(len(masks), -1), axis=1))


def unpack(bits: Tensor, size: Sequence[int]) -> Tensor:
    """Unpack masks (M, H W / 8) uint8 into (M, H, W) bool."""
    return torch.from_numpy(numpy.unpackbits(bits.numpy(), axis=1)).bool().reshape(len(bits), *size)


def boxes(masks: Tensor) -> Tensor:
    """Return boxes (K, 4) of masks (K, H, W): left, top, right, bottom edge [pixels]."""
    from torchvision.ops import masks_to_boxes

    return masks_to_boxes(masks) + torch.tensor([0, 0, 1, 1])


def semantic(labels: Tensor, masks: Tensor) -> Tensor:
    """Return the class of each pixel (H, W), 0 for the background and 1 + label otherwise; smaller objects on top."""
    pixel_classes = torch.zeros(masks.shape[-2:], dtype=torch.long)
    for k in masks.sum((1, 2)).argsort(descending=True).tolist():
        pixel_classes[masks[k]] = 1 + labels[k]
    return pixel_classes


def write(dataset: ObjectDataset, images: Path, objects: Path) -> None:
    """Write a split: images as .npy, objects as .safetensors."""
    with writing_array(images, tuple(dataset.images.shape)) as array:
        array[:] = dataset.images.numpy()
    tensors = {"owner": dataset.owner, "labels": dataset.labels, "masks": dataset.masks}
    write_tensors(objects, tensors, {"classes": list(dataset.classes)})


def read(images: Path, objects: Path, *, device: torch.device = CPU) -> ObjectDataset:
    """Read a split written by `write`; images are memory-mapped, not copied.

    Raises:
        FileError: a file is incomplete, or the two files do not match.
    """
    array = map_array(images)
    tensors, notes = read_tensors(objects)
    try:
        dataset = ObjectDataset(
            array, tensors["owner"], tensors["labels"], tensors["masks"], tuple(notes["classes"]), device
        )
    except KeyError as error:
        raise damage_error(objects, f"no {error.args[0]} of objects") from None
    pixels = array.shape[-1] * array.shape[-2]
    if len(dataset.owner) != len(dataset.labels) or dataset.masks.shape != (len(dataset.labels), pixels // 8):
        raise damage_error(objects, "labels, masks and images differ in number or size")
    if len(dataset.owner) and not 0 <= int(dataset.owner.min()) <= int(dataset.owner.max()) < len(array):
        raise FileError(f"{objects}: objects of images that {images} does not have; remove both")
    return dataset
