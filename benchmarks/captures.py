"""Captures by `PsfCamera.all_fields` against `torch.nn.functional.conv2d`: time, and the largest differences.

51 x 51 PSFs at nine fields, reflected borders, the same veil; forward, and forward with backward to the PSFs. Two ways
to convolve directly: `plain`, which a user would write, with the colours as groups and the fields as output channels;
`fastest`, the best of those tried, with a call per colour that takes the images as batch. The differences are the
largest ones of the captures, and of the gradients relative to the largest gradient.
"""

import math
from collections.abc import Callable

import timing
import torch
import torch.nn.functional as F
from scipy.fft import next_fast_len
from torch import Tensor

from tasklens.camera.imaging import PsfCamera

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
    return PsfCamera(psf).all_fields(images)


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


def bare_work(count: int, pixels: int, fields: int, kernel: int, backward: bool) -> dict[str, Callable[[], object]]:
    """Return the least work of captures: each part alone, on planes that stay in the cache.

    Two real planes are one complex plane, or each has half a spectrum: the floor takes the faster one. The forward pass
    transforms images, PSFs and captures; the backward pass transforms captures and PSFs again. In each pass, a capture
    costs one product of spectra and one pass through memory.
    """
    side = 4 * next_fast_len(-(-(pixels + kernel - 1) // 4))
    pairs, passes = math.ceil(count / 2), 1 + backward
    transforms = 3 * (pairs + passes * fields * (1 + pairs))  # PSFs by themselves
    fit = max(1, 2**19 // (8 * side**2))
    planes, other = torch.randn(2, fit, side, side, dtype=torch.complex64)
    real = torch.randn(2 * fit, side, side)
    captures = torch.randn(fields, count, 3, pixels, pixels)
    target, product = torch.empty_like(captures), torch.empty_like(planes)

    def repeat(times: int, work: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(times):
                work()

        return run

    transforms, products = (math.ceil(total / fit) for total in (transforms, 3 * passes * fields * pairs))
    return {
        "complex": repeat(transforms, lambda: torch.fft.fft2(planes)),
        "real": repeat(transforms, lambda: torch.fft.rfft2(real)),
        "products": repeat(products, lambda: torch.mul(planes, other, out=product)),
        "memory": repeat(passes, lambda: target.copy_(captures)),
    }


def floors(camera_work: Callable[[], object], bare: dict[str, Callable[[], object]], rounds: int) -> tuple[str, ...]:
    """Time captures and their least work in turn: parts, floor, PsfCamera [ms], and the ratio of PsfCamera to floor."""
    times = timing.alternate({"camera": camera_work} | bare, rounds)
    transforms = [min(pair) for pair in zip(times["complex"], times["real"], strict=True)]
    floor = [sum(parts) for parts in zip(transforms, times["products"], times["memory"], strict=True)]
    columns = (times["complex"], times["real"], times["products"], times["memory"], floor, times["camera"])
    return *(timing.spread(column, 1e3) for column in columns), timing.ratio(times["camera"], floor)


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--floors", action="store_true", help="only the floors: seconds")
    parser.add_argument("--rounds", type=int, default=9, help="timed runs; the plain way has at most 2")
    options = parser.parse_args(arguments)
    fields, kernel, shapes = (2, 11, ((2, 16),)) if options.tiny else (9, 51, SHAPES)
    rows, least = [], []
    generator = torch.Generator().manual_seed(0)
    for count, pixels in shapes:
        images = torch.rand(count, 3, pixels, pixels, generator=generator)
        psf = torch.rand(fields, 3, kernel, kernel, generator=generator) ** 4
        psf *= 0.8 / psf.sum((-2, -1), keepdim=True)
        upstream = torch.randn(fields, count, 3, pixels, pixels, generator=generator)
        leaf = psf.clone().requires_grad_()

        def forward(way, psf=psf, images=images):
            return lambda: way(psf, images)

        def both(way, leaf=leaf, images=images, upstream=upstream):
            return lambda: torch.autograd.grad(way(leaf, images), leaf, upstream)

        for other in () if options.floors else (plain, fastest):
            difference = differences(camera, other, psf, images, upstream)
            slow = other is plain  # up to a minute each
            rounds = min(2, options.rounds) if slow else options.rounds
            for name, work in [("forward", forward)] * (not slow) + [("forward and backward", both)]:
                times = timing.alternate({"camera": work(camera), "conv2d": work(other)}, rounds)
                a, b = times["camera"], times["conv2d"]
                milliseconds = timing.spread(a, 1e3), timing.spread(b, 1e3)
                rows.append(
                    (f"{count} x {pixels} px", name, other.__name__, *milliseconds, timing.ratio(b, a), difference)
                )
        for name, work in (("forward", forward), ("forward and backward", both)):
            bare = bare_work(count, pixels, fields, kernel, work is both)
            least.append((f"{count} x {pixels} px", name, *floors(work(camera), bare, options.rounds)))
    columns = (
        "images",
        "work",
        "conv2d",
        "PsfCamera [ms]",
        "conv2d [ms]",
        "times faster",
        "differences: values, gradients",
    )
    if rows:
        timing.report(f"Captures at {fields} fields, PSFs of {kernel} x {kernel}", columns, rows, options.save)
    columns = (
        "images",
        "work",
        "complex transforms [ms]",
        "real transforms [ms]",
        "products [ms]",
        "memory [ms]",
        "floor [ms]",
        "PsfCamera [ms]",
        "PsfCamera over floor",
    )
    timing.report("Floors: the least work, each part alone in the cache", columns, least, options.save)


if __name__ == "__main__":
    main()
