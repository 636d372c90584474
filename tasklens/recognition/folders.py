"""Selection of photographs in folders, and their conversion to uint8 arrays on disk."""

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from tasklens.recognition import class_folders, image_tensors
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.files import FileError, resumable_of, writing_array
from tasklens.runtime.progress import Progress

_BLOCK = 64  # photographs per thread task
_SHOWN = 3  # errors listed in a message


@dataclass(frozen=True)
class Listing:
    """Files of photographs, their labels (N,) int64, and the names of the classes."""

    files: tuple[Path, ...]
    labels: Tensor
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.files)

    def take(self, indices: Tensor) -> "Listing":
        """Return the listing of the files with these indices."""
        return Listing(tuple(self.files[i] for i in indices.tolist()), self.labels[indices], self.classes)


def find(split: Path, limit: int | None, seed: int, least: int = 2) -> Listing:
    """Select at most `limit` photographs in <split>/<class>/*, at random by `seed`; print what is passed over.

    Every part of their order has the classes in proportion to their sizes.

    Args:
        least: smallest number of classes.

    Raises:
        FileError: there are too few classes, or one has no photographs.
    """
    classes = class_folders.classes(split, least)
    generator = torch.Generator().manual_seed(seed)
    per_class, others = [], class_folders.beside_classes(split)
    for name in classes:
        files, others_inside = class_folders.contents(split / name)
        if not files:
            raise class_folders.no_image(split / name)
        others += others_inside
        per_class.append([files[i] for i in torch.randperm(len(files), generator=generator)])
    for words in (class_folders.describe_others(split, others), class_folders.folders_inside(split, per_class)):
        if words:
            print(f"tasklens: {words}", file=sys.stderr)
    places = [((i + 0.5) / len(files), k, file) for k, files in enumerate(per_class) for i, file in enumerate(files)]
    selection = sorted(places)[:limit]
    return Listing(
        tuple(file for _, _, file in selection),
        torch.tensor([k for _, k, _ in selection]),
        tuple(map(class_folders.compose_letters, classes)),
    )


def convert(listing: Listing, size: int, path: Path, threads: int, checkpoint: Checkpoint = NO_CHECKPOINT) -> None:
    """Decode photographs into a memory-mapped .npy file, (N, 3, size, size) uint8.

    Args:
        threads: number of decoding threads.
        checkpoint: checkpoint of the job; the part is named after the file.

    Raises:
        FileError: some files are not images (the message counts them), or the disk space is too small for the result
            (checked before decoding).
    """
    progress = Progress(f"reading {listing.files[0].parent.parent}", len(listing))
    part = checkpoint.part(path.stem)
    if part.result is not None and path.exists():
        return
    resume = resumable_of(path).exists() and part.step > 0
    shape = (len(listing), 3, size, size)
    with writing_array(path, shape, resume) as array, ThreadPoolExecutor(threads) as pool:

        def block(first: int) -> int:
            files = listing.files[first : first + _BLOCK]
            for i, file in enumerate(files, first):
                try:
                    array[i] = image_tensors.read(file, size)
                except FileError as error:
                    errors.append(error)
            return first + len(files)

        errors: list[FileError] = []
        futures = [pool.submit(block, first) for first in range(part.step if resume else 0, len(listing), _BLOCK)]
        try:
            for future in futures:
                count = future.result()
                progress(count)
                if checkpoint.due() and not errors:
                    array.flush()
                    part.save(count)
            if errors:
                raise _unreadable(errors, len(listing))
        finally:
            pool.shutdown(cancel_futures=True)
    part.finish()


def read_all(files: Sequence[Path], size: int) -> Tensor:
    """Read the central squares of images, (N, 3, size, size) uint8; raises FileError and counts the failures."""
    images, errors = torch.zeros(len(files), 3, size, size, dtype=torch.uint8), []
    for i, file in enumerate(files):
        try:
            images[i] = image_tensors.read(file, size)
        except FileError as error:
            errors.append(error)
    if errors:
        raise _unreadable(errors, len(files))
    return images


def check_readable(files: Sequence[Path]) -> None:
    """Decode photographs; raises FileError and counts those that cannot be read."""
    errors, progress = [], Progress("checking photographs", len(files))
    for step, file in enumerate(files, 1):
        try:
            image_tensors.decode(file)
        except FileError as error:
            errors.append(error)
        progress(step)
    if errors:
        raise _unreadable(errors, len(files))


def _unreadable(errors: Sequence[FileError], count: int) -> FileError:
    """Return the error for files that are not images."""
    if len(errors) == 1:
        return errors[0]
    examples = "; ".join(str(error) for error in sorted(errors, key=str)[:_SHOWN])
    more = f"; and {len(errors) - _SHOWN} more" if len(errors) > _SHOWN else ""
    return FileError(f"{len(errors)} of {count} images cannot be read; repair or remove them: {examples}{more}")
