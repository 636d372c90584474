"""Labelled pictures: rendered, or read from folders of photographs, as uint8 tensors."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from tasklens.progress import Progress
from tasklens.settings import Images
from tasklens.study import StudyError

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
SPLITS = ("train", "minival", "test")


@dataclass(frozen=True)
class Pictures:
    """Pictures (N, 3, H, W) uint8, their labels (N,) int64 and the names of the classes."""

    images: Tensor
    labels: Tensor
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.labels)

    def batch(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Pictures in [0, 1], float32, and their labels."""
        return self.images[indices].float() / 255, self.labels[indices]

    def batches(self, size: int):
        """All pictures in order, as batches."""
        for indices in torch.arange(len(self)).split(size):
            yield self.batch(indices)

    def take(self, indices: Tensor) -> "Pictures":
        return Pictures(self.images[indices], self.labels[indices], self.classes)


def make(images: Images) -> dict[str, Pictures]:
    """The three splits that `images` describes; the minival is cut out of the training pictures.

    Raises:
        StudyError: a missing folder, an empty class, an unreadable picture, or too few pictures.
    """
    if images.folder is None:
        from tasklens.recognition import scenes

        def rendered(count: int, seed: int) -> Pictures:
            return Pictures(*scenes.render(count, images.size, seed), scenes.CLASSES)

        pool = rendered(images.train + images.minival, 2 * images.seed)
        test = rendered(images.test, 2 * images.seed + 1)
    else:
        limit = None if images.train is None else images.train + images.minival
        pool = _read_folder(_split_folder(images.folder, ("train",)), images.size, limit, images.seed)
        test = _read_folder(_split_folder(images.folder, ("test", "val")), images.size, images.test, images.seed)
        if pool.classes != test.classes:
            different = ", ".join(sorted(set(pool.classes) ^ set(test.classes)))
            raise StudyError(f"{images.folder}: train and test have different classes: {different}")
    if len(pool) <= images.minival:
        raise StudyError(
            f"images.minival = {images.minival}: expected fewer than the {len(pool)} training pictures it is cut from"
        )
    order = torch.randperm(len(pool), generator=torch.Generator().manual_seed(images.seed))
    minival, train = order[: images.minival], order[images.minival :]
    return {"train": pool.take(train), "minival": pool.take(minival), "test": test}


def _split_folder(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_dir():
            return folder / name
    raise StudyError(f"images.folder = {folder}: expected a folder {' or '.join(names)} in it, with a folder per class")


def _read_folder(folder: Path, size: int, limit: int | None, seed: int) -> Pictures:
    """At most `limit` pictures of folder/<class>/*, evenly over the classes and drawn by `seed`."""
    classes = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    if not classes:
        raise StudyError(f"{folder}: expected a folder per class in it, found none")
    generator = torch.Generator().manual_seed(seed)
    per_class = []
    for name in classes:
        files = sorted(f for f in (folder / name).rglob("*") if f.suffix.lower() in SUFFIXES)
        if not files:
            raise StudyError(f"{folder / name}: this class has no picture ({', '.join(SUFFIXES)})")
        per_class.append([files[i] for i in torch.randperm(len(files), generator=generator)])
    rounds = max(map(len, per_class))
    chosen = [(files[i], k) for i in range(rounds) for k, files in enumerate(per_class) if i < len(files)][:limit]
    images = torch.empty(len(chosen), 3, size, size, dtype=torch.uint8)
    progress = Progress(f"reading {folder}", len(chosen))
    for i, (path, _) in enumerate(chosen):
        images[i] = _read_picture(path, size)
        progress(i + 1)
    return Pictures(images, torch.tensor([k for _, k in chosen]), tuple(classes))


def _read_picture(path: Path, size: int) -> Tensor:
    """The central square of a picture as RGB, resized to (3, size, size) uint8."""
    import numpy
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with Image.open(path) as file:
            picture = ImageOps.exif_transpose(file)
            if picture.mode.startswith("I"):  # 16 bits of grey, which `convert` would clip at 255
                picture = picture.convert("I").point(lambda value: value * (1 / 256)).convert("L")
            picture = ImageOps.fit(picture.convert("RGB"), (size, size), Image.Resampling.BICUBIC)
    except (UnidentifiedImageError, OSError) as error:
        raise StudyError(f"{path}: cannot be read as a picture ({error})") from error
    return torch.from_numpy(numpy.array(picture)).permute(2, 0, 1)


def write(pictures: Pictures, path: Path) -> None:
    """Write a split as safetensors: `images`, `labels` and the class names."""
    from tasklens.files import write_tensors

    write_tensors(path, {"images": pictures.images, "labels": pictures.labels}, {"classes": list(pictures.classes)})


def read(path: Path) -> Pictures:
    """Read a split written by `write`."""
    from tasklens.files import read_tensors

    tensors, metadata = read_tensors(path)
    return Pictures(tensors["images"], tensors["labels"], tuple(metadata["classes"]))
