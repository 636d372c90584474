"""Noise and quantisation of a sensor."""

from collections.abc import Sequence

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from tasklens.settings.capture_settings import SensorSettings


def noise(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Return standard normal numbers."""
    return torch.randn(tuple(shape), generator=generator)


def expose(light: Tensor, sensor: SensorSettings, illumination: Tensor, noise: Tensor) -> Tensor:
    """Expose a sensor: shot and read noise, illumination correction, and quantised sRGB values.

    N = W E + sqrt(W E + r^2) z,  value = N / W,  W = illumination * full_well / gain

    E is the linear light of the capture (1 is white), r the read noise. The Gaussian has the mean and variance of the
    Poisson distribution. The gradient passes through the quantisation unchanged.

    Args:
        light: (..., 3, H, W) linear light; clipped to [0, 1].
        illumination: (...) relative illumination.
        noise: standard normal numbers z, in the shape of `light`.
    """
    white = (sensor.full_well / sensor.gain * illumination).clamp(min=1e-6)[..., None, None, None]
    light = light.clamp(0, 1)
    deviation = torch.sqrt(light / white + (max(sensor.read_noise, 1e-3) / white).square())
    exact = linear_rgb_to_rgb((light + deviation * noise).clamp(0, 1))
    levels = 2**sensor.bits - 1
    with torch.no_grad():
        rounding = (exact * levels).round_().div_(levels).sub_(exact)
    return exact + rounding
