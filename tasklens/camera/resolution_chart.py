"""A resolution chart: Siemens stars at the centre and in the corners, line pairs of several frequencies in between."""

import math

import torch
from torch import Tensor

_SPOKES = 24  # pairs
_RADIUS = 0.18  # radius of a star, in chart heights
_PLACES = ((0.0, 0.0), (-0.31, -0.31), (-0.31, 0.31), (0.31, -0.31), (0.31, 0.31))  # of stars, height and width
PERIODS = (2, 3, 4, 6, 8)  # periods of the line pairs [pixels]
_BARS = 4  # line pairs per period
_OVERSAMPLING = 4  # samples per pixel, against aliasing


def resolution_chart(height: int, width: int) -> Tensor:
    """Return a black-and-white chart (3, H, W); each pixel is the mean over its area.

    Groups of vertical and horizontal line pairs lie between the stars, with `PERIODS` in order from the centre.
    """
    fine = height * _OVERSAMPLING, width * _OVERSAMPLING
    y, x = ((torch.arange(n) + 0.5) / _OVERSAMPLING - n / _OVERSAMPLING / 2 for n in fine)
    chart = torch.ones(fine)
    for row, column in _PLACES:
        across, along = x[None] - column * width, y[:, None] - row * height
        spokes = torch.sin(_SPOKES * torch.atan2(along, across)) > 0
        chart[spokes & (torch.hypot(across, along) < _RADIUS * height)] = 0
    for side in (-1, 1):
        _bars(chart, x, y, side, _RADIUS * height * 1.15)
        _bars(chart.T, y, x, side, _RADIUS * height * 1.15)
    return chart.unflatten(0, (height, -1)).unflatten(2, (width, -1)).mean((1, 3)).expand(3, height, width).contiguous()


def _bars(chart: Tensor, x: Tensor, y: Tensor, side: int, start: float) -> None:
    """Draw groups of line pairs in sequence along x, on one side of the centre, from |x| = start."""
    for period in PERIODS:
        length = math.ceil(_BARS * period / 2) * 2
        position = side * x - start
        dark = (position >= 0) & (position < length) & (torch.remainder(position, period) < period / 2)
        chart[(y.abs() < 16)[:, None] & dark[None]] = 0
        start += length + 8
