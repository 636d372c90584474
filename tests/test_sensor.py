"""Noise and levels of the sensor: moments, limits, gradient, the same noise at every measurement."""

import math

import pytest
import torch
from kornia.color import rgb_to_linear_rgb

from tasklens.camera.imaging import PsfCamera, expose, noise
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings

FINE = SensorSettings(bits=16)  # levels far below the noise


def point(fields: int = 1) -> torch.Tensor:
    """PSFs without blur."""
    grid = torch.zeros(fields, 3, 3, 3)
    grid[:, :, 1, 1] = 1
    return grid


@pytest.mark.parametrize("gain, light, share", [(1, 0.5, 1.0), (16, 0.3, 1.0), (4, 0.2, 0.4)])
def test_moments_are_those_of_electrons(gain, light, share):
    """Mean W E and variance W E + r^2, W = 6000 / gain times the illumination; 200 x 200 pixels of three colours."""
    sensor = FINE.model_copy(update={"gain": gain, "read_noise": 3})
    flat = torch.full((1, 3, 200, 200), light)
    capture = expose(flat, sensor, torch.tensor([share]), noise(flat.shape, torch.Generator().manual_seed(1)))
    white = 6000 / gain * share
    electrons = white * rgb_to_linear_rgb(capture.double())
    error = math.sqrt((white * light + 9) / 120_000)
    assert float(electrons.mean()) == pytest.approx(white * light, abs=4 * error)
    assert float(electrons.var()) == pytest.approx(white * light + 9, rel=4 * math.sqrt(2 / 120_000))


def test_much_light_leaves_the_capture_and_its_levels():
    """With 1e9 electrons only the rounding is left: half a level of 4 bits at most, and 16 values."""
    sensor = SensorSettings(full_well=1e9, bits=4)
    image = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    sample = noise(image.shape, torch.Generator().manual_seed(0))
    capture = expose(rgb_to_linear_rgb(image), sensor, torch.ones(2), sample)
    assert (capture - image).abs().max() <= 0.5 / 15 + 1e-6
    torch.testing.assert_close(capture * 15, (capture * 15).round(), rtol=0, atol=1e-5)


def test_gradient_against_differences():
    """With fixed noise, and rounding treated as the identity."""
    sensor = SensorSettings(gain=4, bits=16)
    image = torch.tensor([0.2, 0.4, 0.6]).double().reshape(1, 3, 1, 1).requires_grad_()
    z = noise(image.shape, torch.Generator().manual_seed(0)).double()
    light = torch.ones(1, dtype=torch.float64)
    (slope,) = torch.autograd.grad(expose(image, sensor, light, z).sum(), image)
    step = 0.02  # a thousand levels
    for k in range(3):
        shift = torch.zeros_like(image)
        shift[0, k] = step
        pair = [expose(image.detach() + sign * shift, sensor, light, z).sum() for sign in (1, -1)]
        assert float(pair[0] - pair[1]) / (2 * step) == pytest.approx(float(slope[0, k]), rel=5e-3)


def test_dim_fields_are_noisier_and_as_bright():
    sensor = FINE.model_copy(update={"gain": 16})
    camera = PsfCamera(point(2), sensor=sensor, illumination=torch.tensor([1.0, 0.25]))
    grey = torch.full((4, 3, 64, 64), 0.5)
    captures = rgb_to_linear_rgb(camera.all_fields(grey, torch.Generator().manual_seed(0)).double())
    assert float(captures[1].mean() / captures[0].mean()) == pytest.approx(1, abs=5e-3)
    light, white = float(rgb_to_linear_rgb(grey.double())[0, 0, 0, 0]), 6000 / 16
    relative = [math.sqrt(white * share * light + 4) / share for share in (1.0, 0.25)]
    assert float(captures[1].std() / captures[0].std()) == pytest.approx(relative[1] / relative[0], rel=0.03)


def test_measurements_repeat_their_noise_and_training_draws_it():
    """Each batch has its own noise."""
    pipeline = CapturePipeline(PsfCamera(point(9), sensor=SensorSettings(gain=16)))
    images = torch.rand(6, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(pipeline.all_fields(images), pipeline.all_fields(images))
    assert not torch.equal(pipeline.all_fields(images)[0], images)
    assert not torch.equal(pipeline.all_fields(images, 1), pipeline.all_fields(images, 2))
    samples = [pipeline.one_field(images, torch.Generator().manual_seed(s)) for s in (0, 0, 1)]
    assert torch.equal(samples[0], samples[1]) and not torch.equal(samples[0], samples[2])


@pytest.mark.parametrize("colour", ["srgb", "linear"])
def test_the_blur_is_in_the_colour_space_of_the_study_and_the_noise_in_light(colour):
    """With much light, the capture of a sensor is that without one, to the rounding of its levels."""
    grid = torch.rand(2, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    grid = grid / grid.sum((-2, -1), keepdim=True)
    images = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    sensor = SensorSettings(full_well=1e9, bits=16)
    captures = [
        PsfCamera(grid, colour=colour, sensor=with_or_without).all_fields(images) for with_or_without in (None, sensor)
    ]
    torch.testing.assert_close(captures[1], captures[0], rtol=0, atol=5e-4)


def test_a_sensor_captures_linear_light_unless_a_study_says_otherwise():
    """Noise is that of light; without a sensor, sRGB values are blurred, as we read the paper."""
    assert CaptureSettings().colour == "srgb" and CaptureSettings(sensor=None).colour == "srgb"
    linear = CaptureSettings(sensor=SensorSettings())
    assert linear.colour == CaptureSettings.model_validate({"sensor": {}}).colour == "linear"
    assert CaptureSettings(sensor=SensorSettings(), colour="srgb").colour == "srgb"
    assert CaptureSettings.model_validate(linear.model_dump()) == linear
    for settings in ({}, {"colour": "linear"}, {"sensor": SensorSettings()}, {"colour": "srgb", "sensor": FINE}):
        assert PsfCamera(point(2), **settings).linear == (CaptureSettings(**settings).colour == "linear")
