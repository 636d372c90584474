"""Captures by `Camera.grid` against `torch.nn.functional.conv2d`: time, and the largest differences.

51 x 51 PSFs at nine fields, reflected borders, the same veil; forward, and forward with backward to the PSFs. Two ways
to convolve directly: `plain`, which a user would write, with the colours as groups and the fields as output channels;
`fastest`, the best of those tried, with a call per colour that takes the images as batch. The differences are the
largest of the captures, and of the gradients relative to the largest gradient.
"""

import math
import statistics
import time
from collections.abc import Callable

import timing
import torch
import torch.nn.functional as F
from torch import Tensor

from tasklens.imaging import Camera

SHAPES = ((16, 64), (4, 224))  # images, pixels


def with_veil(blurred: Tensor, psf: Tensor, images: Tensor) -> Tensor:
    return blurred + (1 - psf.sum((-2, -1), keepdim=True))[:, None] * images.mean((-2, -1), keepdim=True)


def reflected(images: Tensor, psf: Tensor) -> Tensor:
    return F.pad(images, (psf.shape[-1] // 2,) * 4, mode="reflect")


def plain(psf: Tensor, images: Tensor) -> Tensor:
    """One grouped convolution, colour by colour; conv2d correlates, hence the flip."""
    weight = psf.flip(-2, -1).transpose(0, 1).flatten(0, 1)[:, None]
    blurred = F.conv2d(reflected(images, psf), weight, groups=3).unflatten(1, (3, len(psf)))
    return with_veil(blurred.permute(2, 0, 1, 3, 4), psf, images)


def fastest(psf: Tensor, images: Tensor) -> Tensor:
    """A convolution per colour, without groups."""
    padded, weight = reflected(images, psf), psf.flip(-2, -1)
    blurred = torch.stack([F.conv2d(padded[:, c, None], weight[:, c, None]) for c in range(3)], 2)
    return with_veil(blurred.transpose(0, 1), psf, images)


def camera(psf: Tensor, images: Tensor) -> Tensor:
    return Camera(psf).grid(images)


def differences(render: Callable, other: Callable, psf: Tensor, images: Tensor, upstream: Tensor) -> str:
    """Largest difference of the captures, and of the gradients relative to the largest gradient."""
    captures, gradients = [], []
    for way in (render, other):
        leaf = psf.clone().requires_grad_()
        captures.append(way(leaf, images))
        gradients.append(torch.autograd.grad(captures[-1], leaf, upstream)[0])
    value = (captures[0] - captures[1]).abs().max().item()
    gradient = ((gradients[0] - gradients[1]).abs().max() / gradients[1].abs().max()).item()
    return f"{value:.0e}, {gradient:.0e}"


def floor_ms(count: int, pixels: int, fields: int, kernel: int) -> tuple[float, float]:
    """Compute the least time of forward and backward, by arithmetic and by memory traffic [ms].

    Transforms of 2.5 N log2 N operations, of images, PSFs, captures and back again, at the rate of transforms of rows
    in the cache; captures and their gradients go through memory once, at the rate of a copy.
    """
    side = pixels + kernel - 1
    length = 128 if side <= 128 else 256
    rows, large = torch.randn(256, length), torch.randn(2**24)
    copy = torch.empty_like(large)

    def rate(amount: float, function: Callable[[], object]) -> float:
        times = []
        for _ in range(50):
            begin = time.perf_counter()
            function()
            times.append(time.perf_counter() - begin)
        return amount / statistics.median(times[10:])

    per_second = rate(256 * 2.5 * length * math.log2(length), lambda: torch.fft.rfft(rows))
    bytes_per_second = rate(8 * large.numel(), lambda: copy.copy_(large))
    transforms = 3 * (count + 2 * fields + 2 * fields * count)
    arithmetic = transforms * 2.5 * side**2 * math.log2(side**2) / per_second
    traffic = 2 * 4 * 3 * fields * count * pixels**2 / bytes_per_second
    return 1e3 * arithmetic, 1e3 * traffic


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=9, help="timed runs; the plain way has at most 2")
    options = parser.parse_args(arguments)
    fields, kernel, shapes = (2, 11, ((2, 16),)) if options.tiny else (9, 51, SHAPES)
    rows, floors = [], []
    generator = torch.Generator().manual_seed(0)
    for count, pixels in shapes:
        images = torch.rand(count, 3, pixels, pixels, generator=generator)
        psf = torch.rand(fields, 3, kernel, kernel, generator=generator) ** 4
        psf *= 0.8 / psf.sum((-2, -1), keepdim=True)
        upstream = torch.randn(fields, count, 3, pixels, pixels, generator=generator)
        leaf = psf.clone().requires_grad_()
        for other in (plain, fastest):
            difference = differences(camera, other, psf, images, upstream)

            def forward(way, psf=psf, images=images):
                return lambda: way(psf, images)

            def both(way, leaf=leaf, images=images, upstream=upstream):
                return lambda: torch.autograd.grad(way(leaf, images), leaf, upstream)

            slow = other is plain  # up to a minute each
            rounds = min(2, options.rounds) if slow else options.rounds
            for name, work in [("forward", forward)] * (not slow) + [("forward and backward", both)]:
                times = timing.alternate({"camera": work(camera), "conv2d": work(other)}, rounds)
                a, b = times["camera"], times["conv2d"]
                milliseconds = timing.spread(a, 1e3), timing.spread(b, 1e3)
                rows.append(
                    (f"{count} x {pixels} px", name, other.__name__, *milliseconds, timing.ratio(b, a), difference)
                )
        arithmetic, traffic = floor_ms(count, pixels, fields, kernel)
        floors.append((f"{count} x {pixels} px", f"{arithmetic:.1f}", f"{traffic:.1f}"))
    columns = (
        "images",
        "work",
        "conv2d",
        "Camera [ms]",
        "conv2d [ms]",
        "times faster",
        "differences: values, gradients",
    )
    timing.report(f"Captures at {fields} fields, PSFs of {kernel} x {kernel}", columns, rows, options.save)
    columns = ("images", "arithmetic of the transforms [ms]", "captures and their gradients through memory [ms]")
    timing.report("Floors of forward and backward", columns, floors, options.save)


if __name__ == "__main__":
    main()
