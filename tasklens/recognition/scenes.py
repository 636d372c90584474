"""The built-in labelled data set: textured objects, rendered procedurally.

A lens design supervised by a classifier needs images whose label depends on detail that a lens can blur. Here only the
fine texture of an object defines its class. Pose, colours, shape, contrast and background have the same distributions
for all classes; every texture covers half of its surface and has the same range of periods. If a lens does not resolve
the period, accuracy is at chance level. Rendering needs only torch: no download, no licence, any number of images.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

EDGE = 0.7  # scale of the smooth step across a texture's edges, which avoids aliasing [pixels]
NOISE = 0.015  # standard deviation of the sensor noise, full scale 1
CHUNK = 200  # images rendered at a time


def _line(u: Tensor) -> Tensor:
    """Compute the distance from `u` to the nearest integer."""
    return (u - u.round()).abs()


def _both(a: Tensor, b: Tensor) -> Tensor:
    """Combine signed distances: the smaller distance, with the product of the signs."""
    return a.sign() * b.sign() * torch.minimum(a.abs(), b.abs())


# Each texture maps coordinates (u, v) [periods] to the signed distance [periods] from the edge between its light and
# dark colours, positive in the light colour. The offsets give each colour half of the area.


def _stripes(u: Tensor, v: Tensor) -> Tensor:
    return _line(u) - 0.25


def _checkerboard(u: Tensor, v: Tensor) -> Tensor:
    # The longest period of a checkerboard is diagonal: sqrt(0.5) makes it 1.
    return _both(_stripes(u * math.sqrt(0.5), v), _stripes(v * math.sqrt(0.5), u)) * math.sqrt(2)


def _dots(u: Tensor, v: Tensor) -> Tensor:
    pitch = 2 / math.sqrt(3)  # for a distance of 1 between rows of the hexagonal lattice
    even = torch.hypot(_line(u / pitch) * pitch, _line(v / 2) * 2)
    odd = torch.hypot(_line(u / pitch + 0.5) * pitch, _line(v / 2 + 0.5) * 2)
    return torch.minimum(even, odd) - math.sqrt(pitch / 2 / math.pi)


def _rings(u: Tensor, v: Tensor) -> Tensor:
    return _stripes(torch.hypot(u, v), v)


def _zigzag(u: Tensor, v: Tensor) -> Tensor:
    # Slopes of 1 on either side, hence sqrt(0.5) for a period of 1 across each leg.
    return _stripes(v * math.sqrt(0.5) + 1.5 * _line(u * math.sqrt(0.5) / 1.5), u)


def _bricks(u: Tensor, v: Tensor) -> Tensor:
    joint = 2 * _line(u / 2 + v.floor() / 2)
    return torch.minimum(_line(v), joint) - 0.191


def _grid(u: Tensor, v: Tensor) -> Tensor:
    return torch.minimum(_line(u), _line(v)) - (1 - math.sqrt(0.5)) / 2


def _weave(u: Tensor, v: Tensor) -> Tensor:
    # Cells of side 2 with two parallel bars each, which end 0.1 before the cell's border.
    upright = _both(_line(u / 4) - 0.25, _line(v / 4) - 0.25) > 0
    across, along = torch.where(upright, u, v), torch.where(upright, v, u)
    return torch.maximum(_line(across + 0.5) - 0.278, 0.1 - 2 * _line(along / 2 + 0.5))


def _waves(u: Tensor, v: Tensor) -> Tensor:
    # Slopes of up to 1.4, and 1.5 times the zigzag's repeat length.
    return _stripes(v * 0.7 + 0.5 * torch.sin(u * 2), u)


_TEXTURES: dict[str, Callable[[Tensor, Tensor], Tensor] | None] = {
    "stripes": _stripes,
    "checkerboard": _checkerboard,
    "dots": _dots,
    "rings": _rings,
    "zigzag": _zigzag,
    "bricks": _bricks,
    "grid": _grid,
    "weave": _weave,
    "waves": _waves,
    "labyrinth": None,  # band-passed noise, not a function of the coordinates
}
CLASSES: tuple[str, ...] = tuple(_TEXTURES)


def filter_noise(noise: Tensor, gain: Callable[[Tensor], Tensor]) -> Tensor:
    """Filter white noise, and scale every plane to mean 0 and standard deviation 1.

    Args:
        noise: white noise, (..., size, size).
        gain: function from the frequency [cycles/pixel], (size, size // 2 + 1), to the filter's gain.

    Returns:
        The filtered noise, (..., size, size).
    """
    size = noise.shape[-1]
    frequency = torch.hypot(torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size))
    frequency[0, 0] = 1e-3  # any finite value, since the mean is removed
    field = torch.fft.irfft2(torch.fft.rfft2(noise) * gain(frequency), s=(size, size))
    field = field - field.mean((-2, -1), keepdim=True)
    return field / field.std((-2, -1), keepdim=True)


class Draw:
    """Random numbers for `count` planes of `size` x `size` pixels."""

    def __init__(self, count: int, size: int, generator: torch.Generator):
        self.count, self.size, self.generator = count, size, generator

    def uniform(self, low: float, high: float, *channels: int) -> Tensor:
        """Return (count, channels or 1, 1, 1) numbers between `low` and `high`."""
        return low + (high - low) * torch.rand(self.count, *(channels or (1,)), 1, 1, generator=self.generator)

    def white(self, channels: int) -> Tensor:
        """Return white noise (count, channels, size, size)."""
        return torch.randn(self.count, channels, self.size, self.size, generator=self.generator)


def surfaces(name: str, count: int, size: int, periods: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Render planes covered by the texture of one class, (count, 3, size, size), values about 0 to 1.

    Args:
        name: class, one of `CLASSES`.
        count: number of images.
        size: height and width [pixels].
        periods: range of texture periods, sampled log-uniformly [pixels].
        generator: generator of all random numbers.
    """
    draw = Draw(count, size, generator)
    uniform, white = draw.uniform, draw.white
    # Pose: position, perspective, stretch, rotation and scale of the texture on the object.
    period = torch.exp(uniform(math.log(periods[0]), math.log(periods[1])))
    angle, stretch, half = uniform(-0.4, 0.4), uniform(0.9, 1.1), size / 2
    pixels = torch.arange(size) - half + 0.5
    x, y = pixels - uniform(-half / 2, half / 2), pixels[:, None] - uniform(-half / 2, half / 2)
    depth = 1 + (uniform(-0.05, 0.05) * x + uniform(-0.05, 0.05) * y) / half  # with `stretch`, down to 0.8 periods
    u = (angle.cos() * x + angle.sin() * y) * stretch / (period * depth)
    v = (angle.cos() * y - angle.sin() * x) / (stretch * period * depth)
    texture = _TEXTURES[name]
    if texture is None:
        distance = filter_noise(white(1), lambda f: torch.exp(-((torch.log(f * period) / 0.25) ** 2) / 2)) / 4
    else:
        distance = texture(u, v)
    pattern = torch.tanh(distance * period / EDGE)

    # Light and dark colours are symmetric about a medium one, so that all classes have the same mean and contrast.
    swing = uniform(0.1, 0.35, 3)
    return uniform(0.35, 0.65, 3) + swing * (pattern - pattern.mean((-2, -1), keepdim=True))


def backgrounds(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Render backgrounds, (count, 3, size, size): coloured noise without fine detail."""
    draw = Draw(count, size, generator)
    return draw.uniform(0.2, 0.8, 3) + draw.uniform(0.05, 0.15) * filter_noise(draw.white(3), lambda f: 1 / f)


def to_uint8(image: Tensor, generator: torch.Generator) -> Tensor:
    """Add sensor noise to images (count, 3, size, size), and convert them to uint8."""
    noisy = image + NOISE * torch.randn(image.shape, generator=generator)
    return (noisy * 255).round().clamp(0, 255).byte()


def _scenes(name: str, count: int, size: int, periods: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Render scenes of one object, (count, 3, size, size), uint8; arguments as in `surfaces`."""
    surface = surfaces(name, count, size, periods, generator)
    ground = backgrounds(count, size, generator)
    draw, half = Draw(count, size, generator), size / 2
    pixels = torch.arange(size) - half + 0.5

    # A smooth random shape around the centre; a quantile sets the fraction of the image that it covers.
    reach = torch.hypot(pixels, pixels[:, None]) / half
    shape = filter_noise(draw.white(1), lambda f: torch.exp(-((f * size / 1.5) ** 2) / 2)) / 4 - reach
    mask = shape_mask(shape, draw.uniform(0.1, 0.5))
    return to_uint8(ground + mask * (surface - ground), generator)


def shape_mask(shape: Tensor, hidden: Tensor) -> Tensor:
    """Return the mask (count, 1, size, size) of a shape without its lowest fraction `hidden` (count, 1, 1, 1)."""
    size = shape.shape[-1]
    rank = (hidden * (size * size - 1)).round().long()
    level = shape.flatten(2).sort().values.unsqueeze(2).gather(3, rank)
    return torch.sigmoid((shape - level) * (size / 2))


def render(count: int, size: int, seed: int, periods: tuple[float, float] = (5.0, 16.0)) -> tuple[Tensor, Tensor]:
    """Render a balanced, shuffled set of labelled images on the CPU.

    Args:
        count: number of images, at least one per class.
        size: height and width [pixels], at least 16.
        seed: seed of all random numbers.
        periods: range of texture periods [pixels].

    Returns:
        Images, (count, 3, size, size), uint8, and their indices into `CLASSES`, (count,), int64.

    Raises:
        ValueError: `count` or `size` is too small.
    """
    if count < len(CLASSES):
        raise ValueError(f"count is {count}, expected at least {len(CLASSES)}: one image per class")
    if size < 16:
        raise ValueError(f"size is {size}, expected at least 16 pixels")
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) * len(CLASSES) // count
    images = torch.empty(count, 3, size, size, dtype=torch.uint8)
    for label, name in enumerate(CLASSES):
        for rows in (labels == label).nonzero().squeeze(1).split(CHUNK):
            images[rows] = _scenes(name, len(rows), size, periods, generator)
    order = torch.randperm(count, generator=generator)
    return images[order], labels[order]
