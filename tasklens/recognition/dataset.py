"""Labelled pictures as uint8 tensors: rendered, or converted from folders of photographs, and read back."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from tasklens.recognition import folders
from tasklens.runtime.checkpoints import NOTHING_KEPT, Checkpoint
from tasklens.runtime.devices import CPU, send
from tasklens.runtime.files import FileError, map_tensors, write_tensors
from tasklens.study.settings import Images

SPLITS = ("train", "minival", "test")


@dataclass(frozen=True)
class Pictures:
    """Pictures (N, 3, H, W) uint8, their labels (N,) int64, the names of the classes, and where batches are wanted."""

    images: Tensor
    labels: Tensor
    classes: tuple[str, ...]
    device: torch.device = CPU

    def __len__(self) -> int:
        return len(self.labels)

    def batch(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Pictures in [0, 1], float32, and their labels."""
        return send(self.images[indices], self.device).float() / 255, send(self.labels[indices], self.device)

    def take(self, indices: Tensor) -> "Pictures":
        return replace(self, images=self.images[indices], labels=self.labels[indices])


def make(images: Images, paths: Mapping[str, Path], threads: int = 1, checkpoint: Checkpoint = NOTHING_KEPT) -> None:
    """Write the three splits that `images` describes; the minival is cut out of the training pictures.

    Args:
        paths: of the files of the splits.
        threads: that decode photographs at once.
        checkpoint: of the job.

    Raises:
        FileError: a missing folder, an empty class, an unreadable picture, or too few pictures.
    """
    if images.folder is None:
        pool = _rendered(images.train + images.minival, images.size, 2 * images.seed)
        test = _rendered(images.test, images.size, 2 * images.seed + 1)
    else:
        limit = None if images.train is None else images.train + images.minival
        pool = folders.find(images.folder, ("train",), limit, images.seed)
        test = folders.find(images.folder, ("test", "val"), images.test, images.seed)
        if pool.classes != test.classes:
            different = ", ".join(sorted(set(pool.classes) ^ set(test.classes)))
            raise FileError(f"{images.folder}: train and test have different classes: {different}")
    if len(pool) <= images.minival:
        raise FileError(
            f"images.minival = {images.minival}: expected fewer than the {len(pool)} training pictures it is cut from"
        )
    order = torch.randperm(len(pool), generator=torch.Generator().manual_seed(images.seed))
    minival, train = order[: images.minival], order[images.minival :]
    for split, chosen in (("train", pool.take(train)), ("minival", pool.take(minival)), ("test", test)):
        if images.folder is None:
            write(chosen, paths[split])
        else:
            folders.convert(chosen, images.size, paths[split], threads, checkpoint)


def _rendered(count: int, size: int, seed: int) -> Pictures:
    from tasklens.recognition import scenes

    return Pictures(*scenes.render(count, size, seed), scenes.CLASSES)


def write(pictures: Pictures, path: Path) -> None:
    """Write a split as safetensors: `images`, `labels` and the class names."""
    write_tensors(path, {"images": pictures.images, "labels": pictures.labels}, {"classes": list(pictures.classes)})


def read(path: Path, device: torch.device = CPU) -> Pictures:
    """Read a split written by `make`; its pictures are mapped from the file, not copied."""
    tensors, metadata = map_tensors(path)
    return Pictures(tensors["images"], tensors["labels"], tuple(metadata["classes"]), device)
