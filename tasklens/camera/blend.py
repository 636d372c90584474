"""Captures of a whole sensor with a PSF that varies smoothly over the field.

The PSF h_q of its field spreads the light of pixel q. It is interpolated between the PSFs h_n at the nodes n of a grid:

    capture(p) = sum_q h_q(p - q) image(q),   h_q = sum_n w_n(q) h_n
               = sum_n (h_n * (w_n image))(p)

The weights w_n are bilinear between nodes: continuous, with sum 1, and zero beyond the neighbours of the node. A
capture is therefore a sum of FFT convolutions of small tiles. The capture of a point source is the PSF of its field.

A PSF is the sum of a core on sensor pixels and a halo on larger pixels. The halo is the light outside the core window.
Light that leaves the frame is reflected at its edge, as if the scene continued as its mirror image; light outside both
windows returns as a uniform veil. A capture therefore has the same total light as its image.
"""

from dataclasses import dataclass
from itertools import groupby
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils.checkpoint import checkpoint

from tasklens.runtime.errors import InputError


@dataclass(frozen=True)
class SensorPsfs:
    """PSFs over the quadrant x, y >= 0 of a sensor of H x W pixels; the other quadrants are mirror images.

    Attributes:
        shape: H and W.
        y: (Y,) distances of the nodes from the centre [pixels], from 0 to (H - 1) / 2.
        x: (X,) the same, to (W - 1) / 2.
        core: (Y, X, 3, K, K) light inside the core window, K odd; rows along y, columns along x.
        halo: (Y, X, 3, M, M) light outside the core window, on pixels `halo_pixel` times as wide, M odd; None: no halo.
        halo_pixel: width of a halo pixel [pixels].
        source: (H, W, 2) point (x, y) of the image that each pixel samples, from the image centre, in units of half
            the image width and height; None: no distortion.
        illumination: (H, W) relative illumination; None: uniform.
    """

    shape: tuple[int, int]
    y: Tensor
    x: Tensor
    core: Tensor
    halo: Tensor | None = None
    halo_pixel: int = 1
    source: Tensor | None = None
    illumination: Tensor | None = None

    @property
    def energy_inside(self) -> Tensor:
        """Energy (Y X,) inside both windows, the mean over the colours."""
        halo = 0 if self.halo is None else self.halo.detach().sum((-2, -1))
        return (self.core.detach().sum((-2, -1)) + halo).mean(-1).flatten()

    @property
    def margin(self) -> int:
        """Largest distance [pixels] of light beyond the frame."""
        halo = 0 if self.halo is None else self.halo_pixel * (self.halo.shape[-1] // 2)
        return max(halo, self.core.shape[-1] // 2)


def capture(image: Tensor, psfs: SensorPsfs, colour: Literal["srgb", "linear"] = "srgb") -> Tensor:
    """Capture an image (3, H, W) of sRGB values with traced PSFs; differentiable in both."""
    if colour == "linear":
        return linear_rgb_to_rgb(blend(rgb_to_linear_rgb(image), psfs))
    return blend(image, psfs, linear=False)


def blend(image: Tensor, psfs: SensorPsfs, linear: bool = True) -> Tensor:
    """Render the capture (3, H, W) of an image (3, H, W); differentiable in the image and in the core and halo of PSFs.

    To save memory, the backward pass keeps only the image and convolves each row of tiles again.

    Args:
        linear: whether the image is linear light; if not, its sRGB values are decoded to apply the illumination.

    Raises:
        InputError: the image has another shape, or is smaller than the margin of the PSFs.
    """
    height, width = psfs.shape
    if image.shape != (3, height, width):
        raise InputError(
            f"image of shape {tuple(image.shape)}: expected {(3, height, width)}, as its PSFs were traced for"
        )
    margin = psfs.margin
    if margin > min(height, width):
        raise InputError(
            f"image of {height} x {width} pixels: too small for PSFs of {2 * margin + 1}; expected {margin} at least"
        )
    if psfs.source is not None:
        image = F.grid_sample(
            image[None], psfs.source[None].to(image), "bicubic", padding_mode="reflection", align_corners=False
        )[0]
    if psfs.illumination is not None:
        share = psfs.illumination.to(image)
        image = image * share if linear else linear_rgb_to_rgb(rgb_to_linear_rgb(image) * share)
    canvas = F.pad(_convolve(image, psfs.core, psfs, 1), (margin - psfs.core.shape[-1] // 2,) * 4)
    if psfs.halo is not None:
        step = psfs.halo_pixel
        large = F.avg_pool2d(F.pad(image, (0, -width % step, 0, -height % step)), step)
        spread = F.interpolate(_convolve(large, psfs.halo, psfs, step)[None], scale_factor=step, mode="bilinear")[0]
        beyond = margin - step * (psfs.halo.shape[-1] // 2)
        canvas = canvas + F.pad(spread, (beyond,) * 4)[:, : canvas.shape[1], : canvas.shape[2]]
    capture = _fold(_fold(canvas, margin).mT, margin).mT
    missing = image.double().sum((-2, -1), keepdim=True) - capture.double().sum((-2, -1), keepdim=True)
    return capture + (missing / (height * width)).to(capture)


def _fold(canvas: Tensor, margin: int) -> Tensor:
    """Reflect the first and the last `margin` rows of (3, n, m) at the edges of the frame between them."""
    before, frame, after = canvas.split((margin, canvas.shape[1] - 2 * margin, margin), 1)
    rest = frame.shape[1] - margin
    return frame + F.pad(before.flip(1), (0, 0, 0, rest)) + F.pad(after.flip(1), (0, 0, rest, 0))


class _Hat(NamedTuple):
    """Weights of a node along an axis: node index, first pixel with a weight, and the weights from that pixel."""

    node: int
    first: int
    weights: Tensor


def _hats(half: Tensor, pixels: int, length: int, step: int) -> list[_Hat]:
    """Return the weights along an axis of `pixels` sensor pixels, for `length` pixels `step` times as wide.

    Args:
        half: distances of the nodes from the centre [sensor pixels].
    """
    node = torch.cat([-half[1:].flip(0), half]) + (pixels - 1) / 2
    position = (torch.arange(length) * step + (step - 1) / 2).clamp(max=pixels - 1.0)  # pixel centres
    neighbours = torch.cat([node[:1] - 1, node, node[-1:] + 1])
    hats = []
    for index, (left, centre, right) in enumerate(zip(neighbours, node, neighbours[2:], strict=False)):
        weights = torch.minimum((position - left) / (centre - left), (right - position) / (right - centre))
        indices = (weights > 0).nonzero()[:, 0].tolist()
        if indices:  # a hat may lie between the centres of two large pixels
            hats.append(_Hat(index, indices[0], weights[indices].float()))
    return hats


def _convolve(image: Tensor, quadrant: Tensor, psfs: SensorPsfs, step: int) -> Tensor:
    """Spread the light of an image (3, h, w) by core or halo (Y, X, 3, K, K), to (3, h + K - 1, w + K - 1).

    The pixels of both are `step` times as wide as sensor pixels.
    """
    _, height, width = image.shape
    reach = quadrant.shape[-1] - 1
    columns = _hats(psfs.x, psfs.shape[1], width, step)
    widest = max(len(hat.weights) for hat in columns)
    canvas = image.new_zeros(3, height + reach, width + widest + reach)
    image = F.pad(image, (0, widest))  # tiles may extend beyond the frame, where there is no light
    centre = len(psfs.y) - 1
    for hat in _hats(psfs.y, psfs.shape[0], height, step):
        kernels = quadrant[abs(hat.node - centre)]
        rows = image[:, hat.first : hat.first + len(hat.weights)] * hat.weights[:, None]
        kernels = kernels.flip(-2) if hat.node < centre else kernels
        if torch.is_grad_enabled() and (rows.requires_grad or kernels.requires_grad):
            strip = checkpoint(_strip, rows, columns, kernels, use_reentrant=False)  # importing it takes a second
        else:
            strip = _strip(rows, columns, kernels)
        canvas[:, hat.first : hat.first + strip.shape[1]] += strip
    return canvas[..., : width + reach]


def _strip(rows: Tensor, columns: list[_Hat], quadrant: Tensor) -> Tensor:
    """Spread the light of weighted rows (3, t, w) by the PSFs (X, 3, K, K) of a row of nodes, tile by tile."""
    reach = quadrant.shape[-1] - 1
    kernels = torch.cat([quadrant[1:].flip(0, -1), quadrant])
    height = rows.shape[1] + reach
    strip = rows.new_zeros(3, height, rows.shape[2] + reach)
    for width, group in groupby(columns, lambda hat: _fast_size(len(hat.weights) + reach)):
        hats = list(group)
        weights = pad_sequence([hat.weights for hat in hats], batch_first=True)
        tiles = torch.stack([rows[..., hat.first : hat.first + weights.shape[1]] for hat in hats])
        size = _fast_size(height), width
        spectra = torch.fft.rfft2(tiles * weights[:, None, None], size)
        product = spectra * torch.fft.rfft2(kernels[[hat.node for hat in hats]], size)
        spread = torch.fft.irfft2(product, size)[..., :height, : weights.shape[1] + reach]
        for hat, tile in zip(hats, spread, strict=True):
            strip[..., hat.first : hat.first + tile.shape[-1]] += tile
    return strip


def _fast_size(pixels: int) -> int:
    return next_fast_len(pixels, real=True)
