"""Exposure of a sensor: shot and read noise, and quantised sRGB values."""

from typing import Any

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from tasklens.runtime.first_derivative import FirstDerivative
from tasklens.runtime.tensors import explain_errors
from tasklens.settings.capture_settings import SensorSettings

_DARK = 0.0031308  # linear light below which sRGB is linear, and its slope there
_DARK_SLOPE = 12.92


def expose(light: Tensor, sensor: SensorSettings, illumination: Tensor, noise: Tensor) -> Tensor:
    """Expose a sensor: shot and read noise, illumination correction, and quantised sRGB values.

    N = W E + sqrt(W E + r^2) z,  value = N / W,  W = illumination * full_well / gain

    E is the linear light of the capture (1 is white), r the read noise. The Gaussian has the mean and variance of the
    Poisson distribution. The gradient passes through the quantisation unchanged; second derivatives raise InputError.

    Args:
        light: (..., 3, H, W) linear light; clipped to [0, 1].
        illumination: (...) relative illumination.
        noise: standard normal numbers z, in the shape of `light`.
    """
    white = (sensor.full_well / sensor.gain * illumination).clamp(min=1e-6)[..., None, None, None]
    return _Exposure.apply(light, white, noise, max(sensor.read_noise, 1e-3), 2**sensor.bits - 1)


class _Exposure(torch.autograd.Function):
    """Quantised values, with the gradient of the exact ones in closed form: torch's graph takes longer."""

    @staticmethod
    def forward(ctx: Any, light: Tensor, white: Tensor, noise: Tensor, read: float, levels: int) -> Tensor:
        """Expose light (..., 3, H, W); `white` (..., 1, 1, 1) and `read` are electrons."""
        clipped = light.clamp(0, 1)
        deviation = (clipped / white).add_((read / white).square()).sqrt_()
        value = torch.addcmul(clipped, deviation, noise)
        exact = linear_rgb_to_rgb(value.clamp(0, 1))
        ctx.save_for_backward(light, white, noise, deviation, value, exact)
        ctx.read = read
        return (exact * levels).round_().div_(levels)

    @staticmethod
    @explain_errors
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to light and white."""

        def gradients(gradient: Tensor, light: Tensor, white: Tensor, noise: Tensor, *results: Tensor) -> list:
            deviation, value, exact = results
            bright = value.clamp(_DARK, 1)
            slope = (exact + 0.055).div_(2.4 * bright)  # of 1.055 v^(1 / 2.4) - 0.055
            slope = torch.where(value > _DARK, slope, _DARK_SLOPE).mul_(gradient)
            slope.mul_(value == value.clamp(0, 1))
            share = noise / (2 * deviation)  # change of the value with the variance
            at_light = torch.addcdiv(slope, slope * share, white).mul_(light == light.clamp(0, 1))
            at_white = None
            if ctx.needs_input_grad[1]:
                variance = light.clamp(0, 1) / white**2 + 2 * ctx.read**2 / white**3
                at_white = (-slope * share * variance).sum((-3, -2, -1), keepdim=True)
            return [at_light, at_white]

        return *FirstDerivative.apply(gradients, gradient, *ctx.saved_tensors), None, None, None
