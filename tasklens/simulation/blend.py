"""Captures of a whole sensor: a PSF that changes over the field, without seams.

Light of the pixel q is spread by the PSF h_q of its field, which is blended from those h_n at the nodes n of a grid:

    capture(p) = sum_q h_q(p - q) image(q),   h_q = sum_n w_n(q) h_n
               = sum_n (h_n * (w_n image))(p)

The weights w_n are bilinear between nodes: continuous, with sum 1, and zero beyond the neighbours of the node. So a
capture is a sum of convolutions of small tiles, by FFT. A star shows the PSF of its field.

A PSF is the sum of a core on pixels and a halo, the light beside the window of the core, on larger pixels. Light that
leaves the frame is reflected at its edge, as if the scene went on as its mirror image; light beside both windows
returns as a uniform veil. So a capture has the sum of its image.
"""

from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils.checkpoint import checkpoint

from tasklens.runtime.errors import InputError


@dataclass(frozen=True)
class FieldPsfs:
    """PSFs over the quadrant x, y >= 0 of a sensor of H x W pixels; the other quadrants are its mirror images.

    Attributes:
        shape: H and W.
        y: (Y,) distances of the nodes from the centre [pixels], from 0 to (H - 1) / 2.
        x: (X,) the same, to (W - 1) / 2.
        core: (Y, X, 3, K, K) light in the window, K odd; rows along y, columns along x.
        halo: (Y, X, 3, M, M) light beside it, on pixels `halo_pixel` times as wide, M odd; None: there is none.
        halo_pixel: width of a pixel of the halo [pixels].
        source: (H, W, 2) point (x, y) of the image that each pixel shows, in units of half its width and height from
            its centre; None: no distortion.
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
    def margin(self) -> int:
        """Distance [pixels] that light can go beyond the frame."""
        halo = 0 if self.halo is None else self.halo_pixel * (self.halo.shape[-1] // 2)
        return max(halo, self.core.shape[-1] // 2)


def blend(image: Tensor, psfs: FieldPsfs, linear: bool = True) -> Tensor:
    """Render the capture (3, H, W) of an image (3, H, W); differentiable in the image and in core and halo of the PSFs.

    For the gradient nothing is kept but the image: each row of tiles is convolved once more.

    Args:
        linear: whether the image is linear light; else it is sRGB values, which are decoded for the illumination.

    Raises:
        InputError: the image has another shape, or is smaller than light can go beyond its edge.
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
    canvas = _grown(_convolve(image, psfs.core, psfs, 1), margin - psfs.core.shape[-1] // 2)
    if psfs.halo is not None:
        step = psfs.halo_pixel
        large = F.avg_pool2d(F.pad(image, (0, -width % step, 0, -height % step)), step)
        spread = F.interpolate(_convolve(large, psfs.halo, psfs, step)[None], scale_factor=step, mode="bilinear")[0]
        beyond = margin - step * (psfs.halo.shape[-1] // 2)
        canvas = canvas + _grown(spread, beyond)[:, : canvas.shape[1], : canvas.shape[2]]
    capture = _folded(_folded(canvas, margin).mT, margin).mT
    missing = image.double().sum((-2, -1), keepdim=True) - capture.double().sum((-2, -1), keepdim=True)
    return capture + (missing / (height * width)).to(capture)


def _grown(canvas: Tensor, margin: int) -> Tensor:
    return F.pad(canvas, (margin,) * 4)


def _folded(canvas: Tensor, margin: int) -> Tensor:
    """Reflect the first and the last `margin` rows of (3, n, m) at the edges of the frame between them."""
    before, frame, after = canvas.split((margin, canvas.shape[1] - 2 * margin, margin), 1)
    beside = frame.shape[1] - margin
    return frame + F.pad(before.flip(1), (0, 0, 0, beside)) + F.pad(after.flip(1), (0, 0, beside, 0))


class _Hat(NamedTuple):
    """Weights of a node along an axis: its index, the first pixel with a weight, and the weights from there on."""

    node: int
    first: int
    weights: Tensor


def _hats(half: Tensor, pixels: int, length: int, step: int) -> list[_Hat]:
    """Return the weights along an axis of `pixels` pixels, for `length` pixels that are `step` times as wide.

    Args:
        half: distances of the nodes from the centre.
    """
    node = torch.cat([-half[1:].flip(0), half]) + (pixels - 1) / 2
    position = (torch.arange(length) * step + (step - 1) / 2).clamp(max=pixels - 1.0)  # of the centres of the pixels
    beside = torch.cat([node[:1] - 1, node, node[-1:] + 1])
    hats = []
    for index, (left, at, right) in enumerate(zip(beside, node, beside[2:], strict=False)):
        weights = torch.minimum((position - left) / (at - left), (right - position) / (right - at))
        covered = (weights > 0).nonzero()[:, 0].tolist()
        if covered:  # a hat may lie between the centres of two large pixels
            hats.append(_Hat(index, covered[0], weights[covered].float()))
    return hats


def _convolve(image: Tensor, quadrant: Tensor, psfs: FieldPsfs, step: int) -> Tensor:
    """Spread the light of an image (3, h, w) by core or halo (Y, X, 3, K, K), to (3, h + K - 1, w + K - 1).

    The pixels of both are `step` times as wide as those of the sensor.
    """
    _, height, width = image.shape
    reach = quadrant.shape[-1] - 1
    columns = _hats(psfs.x, psfs.shape[1], width, step)
    widest = max(len(hat.weights) for hat in columns)
    canvas = image.new_zeros(3, height + reach, width + widest + reach)
    image = F.pad(image, (0, widest))  # tiles may end beyond the frame, where there is no light
    centre = len(psfs.y) - 1
    for hat in _hats(psfs.y, psfs.shape[0], height, step):
        kernels = quadrant[abs(hat.node - centre)]
        rows = image[:, hat.first : hat.first + len(hat.weights)] * hat.weights[:, None]
        kernels = kernels.flip(-2) if hat.node < centre else kernels
        if torch.is_grad_enabled() and (rows.requires_grad or kernels.requires_grad):
            strip = checkpoint(_strip, rows, columns, kernels, use_reentrant=False)  # its import takes a second
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
    for width, same in groupby(columns, lambda hat: _fast_size(len(hat.weights) + reach)):
        hats = list(same)
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
