"""Captures compared with a direct convolution by another library; light outside the PSF window; noise of the sensor."""

import math

import pytest
import torch
from examples import f64
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from kornia.filters import filter2d

from tasklens.camera.exposure import expose
from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.errors import InputError
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings

F, B, K = 4, 3, 11


def random_psf(seed: int, size: int = K) -> torch.Tensor:
    """(F, 3, K, K) without any symmetry, with energies of 0.5 to 0.9."""
    generator = torch.Generator().manual_seed(seed)
    grid = torch.rand(F, 3, size, size, generator=generator) ** 4
    energy = 0.5 + 0.4 * torch.rand(F, 3, 1, 1, generator=generator)
    return grid / grid.sum((-2, -1), keepdim=True) * energy


def random_images(seed: int, height: int = 25, width: int = 32) -> torch.Tensor:
    return torch.rand(B, 3, height, width, generator=torch.Generator().manual_seed(seed))


def direct(images: torch.Tensor, psf: torch.Tensor) -> torch.Tensor:
    """Convolution with reflected borders by kornia, plane by plane, and the veil of the missing light."""
    fields = []
    for kernels in psf:
        planes = [
            filter2d(images[:, c : c + 1], kernels[c : c + 1], border_type="reflect", behaviour="conv")
            + (1 - kernels[c].sum()) * images[:, c : c + 1].mean((-2, -1), keepdim=True)
            for c in range(3)
        ]
        fields.append(torch.cat(planes, 1))
    return torch.stack(fields)


@pytest.mark.parametrize("shape", [(25, 32), (16, 16), (64, 64), (37, 41)])
def test_captures_are_a_convolution_with_a_veil(shape):
    images, psf = random_images(0, *shape), random_psf(1)
    torch.testing.assert_close(PsfCamera(psf).all_fields(images), direct(images, psf), rtol=0, atol=1e-5)


def test_linear_light_is_convolved_with_its_own_veil():
    images, psf = random_images(0), random_psf(1)
    expected = linear_rgb_to_rgb(direct(rgb_to_linear_rgb(images), psf))
    torch.testing.assert_close(PsfCamera(psf, colour="linear").all_fields(images), expected, rtol=0, atol=2e-5)


def test_the_largest_kernel_that_reflection_allows():
    images, psf = random_images(0, 16, 16), random_psf(1, 31)
    torch.testing.assert_close(PsfCamera(psf).all_fields(images), direct(images, psf), rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match=r"15 x 16.*31"):
        PsfCamera(psf).all_fields(images[..., :15, :])


def test_renormalising_deletes_the_veil():
    """It equals a PSF of unit energy; with a veil the contrast is multiplied by the energy in the window."""
    images, psf = random_images(7), random_psf(8)
    energy = psf.sum((-2, -1), keepdim=True)
    renormalised = PsfCamera(psf, outside_window="renormalise").all_fields(images)
    torch.testing.assert_close(renormalised, PsfCamera(psf / energy).all_fields(images), rtol=0, atol=1e-6)
    mean = images.mean((-2, -1), keepdim=True)
    inside = energy[:, None]
    expected = inside * renormalised + (1 - inside) * mean
    torch.testing.assert_close(PsfCamera(psf).all_fields(images), expected, rtol=0, atol=1e-6)


def test_light_adds_up_linearly():
    """Half the light from black, half from white neighbours: 0.5 from encoded values, 0.735 from linear light."""
    grid = torch.zeros(1, 3, K, K)
    grid[..., K // 2, K // 2] = grid[..., K // 2, K // 2 + 1] = 0.5
    images = torch.zeros(1, 3, 16, 16)
    images[..., ::2] = 1
    encoded = 1.055 * 0.5 ** (1 / 2.4) - 0.055  # IEC 61966-2-1
    for colour, value in (("srgb", 0.5), ("linear", encoded)):
        captures = PsfCamera(grid, colour=colour).all_fields(images)[..., 2:-2]
        torch.testing.assert_close(captures, torch.full_like(captures, value), rtol=0, atol=1e-5)


def test_one_camera_renders_images_of_several_sizes():
    """Cached data of one size do not leak into another."""
    psf = random_psf(11)
    camera = PsfCamera(psf)
    for shape in ((25, 32), (32, 25), (20, 20), (25, 32)):
        images = random_images(12, *shape)
        torch.testing.assert_close(camera.all_fields(images), PsfCamera(psf).all_fields(images), rtol=0, atol=0)


@pytest.mark.parametrize("colour", ["srgb", "linear"])
def test_many_images_are_rendered_like_few(colour):
    """Images do not affect each other, however many there are, and one field of each is that of all fields."""
    images = torch.rand(20, 3, 16, 16, generator=torch.Generator().manual_seed(16))
    camera = PsfCamera(random_psf(17), colour=colour)
    captures = torch.cat([camera.all_fields(image[None]) for image in images], 1)
    torch.testing.assert_close(camera.all_fields(images), captures, rtol=0, atol=1e-6)
    fields = torch.arange(20) % len(camera.psf)
    torch.testing.assert_close(camera(images, fields), captures[fields, torch.arange(20)], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [(25, 32), (64, 64)])
@pytest.mark.parametrize("fields", [None, torch.tensor([3, 0, 3])], ids=["all_fields", "one_field"])
def test_gradients_are_those_of_the_direct_convolution(fields, shape):
    """Gradients at PSFs and images, compared with double precision, relative to the largest."""

    def render(psf, images):
        return PsfCamera(psf).all_fields(images) if fields is None else PsfCamera(psf)(images, fields)

    def reference(psf, images):
        return direct(images, psf) if fields is None else direct(images, psf)[fields, torch.arange(B)]

    images, psf = random_images(13, *shape), random_psf(14)
    weight = torch.randn(render(psf, images).shape, generator=torch.Generator().manual_seed(15))
    gradients = []
    for convolve, dtype in ((render, torch.float32), (reference, torch.float64)):
        leaves = [v.to(dtype).requires_grad_() for v in (psf.clone(), images.clone())]
        gradients.append(torch.autograd.grad((convolve(*leaves) * weight.to(dtype)).sum(), leaves))
    for gradient, expected in zip(*gradients, strict=True):
        assert (gradient - expected).abs().max() <= 1e-5 * expected.abs().max()


@pytest.mark.parametrize("leaf", ["psf", "images"])
def test_a_second_derivative_is_refused(leaf):
    """It would be zero where the first derivative does not carry a graph."""
    psf, images = random_psf(4), random_images(9)
    tensor = {"psf": psf, "images": images}[leaf].requires_grad_()
    (first,) = torch.autograd.grad(PsfCamera(psf).all_fields(images).square().sum(), tensor, create_graph=True)
    with pytest.raises(InputError, match="second derivatives"):
        torch.autograd.grad(first.sum(), tensor)


def test_psnr_is_taken_per_image():
    """An error of 0.1 everywhere is 20 dB, of 0.01 is 40 dB; the mean is over decibels, not over errors."""
    reference = torch.full((2, 3, 8, 8), 0.5)
    decibels = psnr(reference + torch.tensor([0.1, 0.01])[:, None, None, None], reference)
    torch.testing.assert_close(decibels, torch.tensor([20.0, 40.0]), rtol=0, atol=1e-3)
    assert torch.isfinite(psnr(reference, reference)).all()


NOISE = SensorSettings()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda psf, images: PsfCamera(psf, outside_window="no"), "outside_window: expected veil or renormalise, got"),
        (lambda psf, images: PsfCamera(psf, colour="lineaR"), "colour: expected srgb or linear, got 'lineaR'"),
        (lambda psf, images: PsfCamera(psf, sensor=6000), "sensor: expected a tasklens.SensorSettings, got 6000"),
        (lambda psf, images: PsfCamera(psf)(images, [-1, 0]), "fields: expected an index from 0 to"),
        (lambda psf, images: PsfCamera(psf)(images, [0, F]), "fields: expected an index from 0 to"),
        (lambda psf, images: PsfCamera(psf)(images, [0]), "for each of 2 images"),
        (lambda psf, images: PsfCamera(psf).all_fields(images, fields=[-1]), "fields: expected an index from 0 to"),
        (lambda psf, images: PsfCamera(psf).all_fields(images, fields=[]), "fields: expected an index from 0 to"),
        (lambda psf, images: PsfCamera(psf)(images, [0, 0], images), "sample: only for a camera with"),
        (lambda psf, images: PsfCamera(psf, sensor=NOISE)(images, [0, 0], [1, 2]), "sample: expected the shape"),
        (lambda psf, images: PsfCamera(psf, illumination=torch.ones(len(psf))), "illumination: only with a `sensor`"),
        (lambda psf, images: PsfCamera(psf, sensor=NOISE, illumination=torch.ones(9)), r"expected \(4,\), got \(9,\)"),
    ],
)
def test_what_a_camera_cannot_use(call, words):
    """Wrong words, fields that the PSFs do not have, and noise without a sensor are named."""
    with pytest.raises(InputError, match=words):
        call(random_psf(4), random_images(9)[:2])


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
    capture = expose(
        flat, sensor, torch.tensor([share]), torch.randn(flat.shape, generator=torch.Generator().manual_seed(1))
    )
    white = 6000 / gain * share
    electrons = white * rgb_to_linear_rgb(capture.double())
    error = math.sqrt((white * light + 9) / 120_000)
    assert float(electrons.mean()) == pytest.approx(white * light, abs=4 * error)
    assert float(electrons.var()) == pytest.approx(white * light + 9, rel=4 * math.sqrt(2 / 120_000))


def test_much_light_leaves_the_capture_and_its_levels():
    """With 1e9 electrons only the rounding is left: half a level of 4 bits at most, and 16 values."""
    sensor = SensorSettings(full_well=1e9, bits=4)
    image = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    sample = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    capture = expose(rgb_to_linear_rgb(image), sensor, torch.ones(2), sample)
    assert (capture - image).abs().max() <= 0.5 / 15 + 1e-6
    torch.testing.assert_close(capture * 15, (capture * 15).round(), rtol=0, atol=1e-5)


def test_gradients_against_differences():
    """With fixed noise, by light and illumination: dark, bright and clipped values; rounding counts as the identity."""
    sensor = SensorSettings(gain=4).model_copy(update={"bits": 40})
    image = f64([0.001, 0.2, 0.6, 1e-6, 0.9, 1.2]).reshape(2, 3, 1, 1)
    z = f64([0.1, -1.0, 0.5, -2.0, 9.0, 1.0]).reshape(image.shape)
    light = f64([1.0, 0.3])

    def total(image, light):
        return (expose(image, sensor, light, z) * f64([1, 2, 3, 4, 5, 6]).reshape(image.shape)).sum()

    assert torch.autograd.gradcheck(total, (image.requires_grad_(), light.requires_grad_()), eps=1e-7, atol=1e-4)


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
