"""A resolution chart: Siemens stars at the centre and in the corners, line pairs of several frequencies between."""

import math

import torch
from torch import Tensor

_SPOKES = 24  # pairs
_RADIUS = 0.18  # of a star, in heights of the chart
_PLACES = ((0.0, 0.0), (-0.31, -0.31), (-0.31, 0.31), (0.31, -0.31), (0.31, 0.31))  # of stars, height and width
PERIODS = (2, 3, 4, 6, 8)  # of the line pairs [pixels]
_BARS = 4  # pairs of each period
_OVERSAMPLING = 4  # of the drawing, against aliasing


def resolution_chart(height: int, width: int) -> Tensor:
    """Return a chart (3, H, W) in black and white, each pixel the mean of the part that it covers.

    Between the stars are groups of line pairs, upright and lying, of the periods `PERIODS` from the centre outward.
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
    """Draw groups of line pairs one after the other along x, on one side of the centre from |x| = start."""
    for period in PERIODS:
        length = math.ceil(_BARS * period / 2) * 2
        at = side * x - start
        dark = (at >= 0) & (at < length) & (torch.remainder(at, period) < period / 2)
        chart[(y.abs() < 16)[:, None] & dark[None]] = 0
        start += length + 8
