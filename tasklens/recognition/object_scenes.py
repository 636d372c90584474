"""The built-in images with objects: textured objects that occlude each other, with exact masks.

Only the texture defines the class of an object, as in `scenes`. If a lens does not resolve its period, accuracy is at
chance level, but outlines are visible through any lens.
"""

import torch
from torch import Tensor

from tasklens.recognition import scenes
from tasklens.recognition.objects import ObjectDataset, pack

MOST = 4  # maximum objects per scene
_AREA = (0.05, 0.2)  # range of an object's fraction of the image, before occlusion
_LEAST_VISIBLE = 0.5  # fraction of an object: one that is occluded more is removed from the scene
_CHUNK = 100  # scenes rendered at a time


def _shapes(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Render masks (count, 1, size, size) in [0, 1] of smooth objects at random positions."""
    draw, half = scenes.Draw(count, size, generator), size / 2
    pixels = torch.arange(size) - half + 0.5
    x = pixels - draw.uniform(-0.7 * half, 0.7 * half)
    y = pixels[:, None] - draw.uniform(-0.7 * half, 0.7 * half)
    shape = scenes.filter_noise(draw.white(1), lambda f: torch.exp(-((f * size / 1.5) ** 2) / 2)) / 8
    return scenes.shape_mask(shape - torch.hypot(x, y) / half, 1 - draw.uniform(*_AREA))


def _scenes(
    count: int, size: int, periods: tuple[float, float], generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render scenes; return images (count, 3, size, size) uint8, owners, labels and visible masks of all objects."""
    labels = torch.randint(len(scenes.CLASSES), (count, MOST), generator=generator)
    numbers = torch.randint(1, MOST + 1, (count,), generator=generator)
    masks = torch.stack([_shapes(count, size, generator)[:, 0] for _ in range(MOST)], 1)
    # Front to back, so that removing an object changes nothing in front of it.
    covered = torch.zeros(count, size, size, dtype=torch.bool)
    present = torch.arange(MOST) < numbers[:, None]
    visible = masks > 0.5
    for k in range(MOST):
        unoccluded = visible[:, k] & ~covered
        present[:, k] &= unoccluded.sum((1, 2)) >= _LEAST_VISIBLE * visible[:, k].sum((1, 2))
        visible[:, k] = unoccluded & present[:, k, None, None]
        covered |= visible[:, k]
    planes = torch.zeros(count, MOST, 3, size, size)
    for label, name in enumerate(scenes.CLASSES):
        indices = (present & (labels == label)).nonzero()
        if len(indices):
            planes[indices[:, 0], indices[:, 1]] = scenes.surfaces(name, len(indices), size, periods, generator)
    image = scenes.backgrounds(count, size, generator)
    for k in reversed(range(MOST)):
        alpha = masks[:, k, None] * present[:, k, None, None, None]
        image = image + alpha * (planes[:, k] - image)
    return scenes.to_uint8(image, generator), present.nonzero()[:, 0], labels[present], visible[present]


def render(count: int, size: int, seed: int, periods: tuple[float, float] = (5.0, 16.0)) -> ObjectDataset:
    """Render images with one to four objects each on the CPU.

    Args:
        count: number of images.
        size: height and width [pixels], at least 32.
        seed: seed of all random numbers.
        periods: range of texture periods [pixels].

    Raises:
        ValueError: `count` or `size` is too small.
    """
    if count < 1 or size < 32 or size % 4:
        raise ValueError(f"{count} images of {size} pixels: expected at least one of 32 or more, a multiple of 4")
    generator = torch.Generator().manual_seed(seed)
    images, owners, labels, masks = [], [], [], []
    for first in range(0, count, _CHUNK):
        chunk = _scenes(min(_CHUNK, count - first), size, periods, generator)
        images.append(chunk[0])
        owners.append(chunk[1] + first)
        labels.append(chunk[2])
        masks.append(pack(chunk[3]))
    return ObjectDataset(torch.cat(images), torch.cat(owners), torch.cat(labels), torch.cat(masks), scenes.CLASSES)
