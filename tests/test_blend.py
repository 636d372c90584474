"""Captures blended from PSFs with known numbers have no seams, lose no light and are differentiable."""

from dataclasses import replace

import pytest
import torch
from examples import f64, random_image

from tasklens.camera.blend import SensorPsfs, blend
from tasklens.runtime.errors import InputError


def with_halo(shape: tuple[int, int], seed: int) -> SensorPsfs:
    """Random PSFs on a small sensor, each its own mirror image on the axes, with a halo on pixels of four."""
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for _ in range(2):
        part = torch.rand(2, 3, 3, 5, 5, generator=generator)
        part[0] += part[0].flip(-2)
        part[:, 0] += part[:, 0].flip(-1)
        parts.append(part)
    total = sum(part.sum((-2, -1), keepdim=True) for part in parts)
    height, width = ((n - 1) / 2 for n in shape)
    nodes = f64([0, height]), f64([0, 0.4 * width, width])
    return SensorPsfs(shape, *nodes, parts[0] / total, parts[1] / total, halo_pixel=4)


def test_the_same_psf_everywhere_is_a_convolution_without_seams():
    psfs = with_halo((41, 50), seed=2)
    kernel = torch.rand(3, 5, 5, generator=torch.Generator().manual_seed(3))
    kernel = kernel + kernel.flip(-2) + kernel.flip(-1) + kernel.flip(-2, -1)
    kernel = kernel / kernel.sum((-2, -1), keepdim=True)
    image = random_image((41, 50), seed=4)
    capture = blend(image, replace(psfs, core=kernel.expand(2, 3, 3, 5, 5), halo=None))
    expected = torch.nn.functional.conv2d(image[None], kernel.flip(-2, -1)[:, None], groups=3)[0]
    torch.testing.assert_close(capture[:, 2:-2, 2:-2], expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("shape", [(33, 47), (40, 32)])
def test_the_four_quadrants_are_mirror_images(shape):
    """Of even and odd sizes, upright and lying: the capture of a mirrored image is the mirrored capture."""
    psfs, image = replace(with_halo(shape, seed=2), halo=None), random_image(shape, seed=2)
    capture = blend(image, psfs)
    assert capture.shape == image.shape
    for axes in ((1,), (2,), (1, 2)):
        torch.testing.assert_close(blend(image.flip(axes), psfs), capture.flip(axes), rtol=0, atol=2e-6)


@pytest.mark.parametrize("shape", [(33, 47), (40, 32)])
def test_no_light_is_lost(shape):
    image = random_image(shape, seed=5)
    torch.testing.assert_close(blend(image, with_halo(shape, 6)).sum((1, 2)), image.sum((1, 2)), rtol=1e-5, atol=0)


def test_gradients_are_the_adjoint_in_image_and_psfs():
    """<A x, y> = <x, A' y> for the image, and for core and halo, in which a capture is linear except for the veil."""
    psfs, image, other = with_halo((21, 30), 3), *(random_image((21, 30), seed) for seed in (5, 6))
    value = (blend(image.requires_grad_(), psfs) * other).sum()
    (gradient,) = torch.autograd.grad(value, image)
    assert (gradient * image).sum().item() == pytest.approx(value.item(), rel=1e-5)
    other = other - other.mean((1, 2), keepdim=True)  # blind to the veil
    for part in ("core", "halo"):
        leaf = getattr(psfs, part).clone().requires_grad_()
        (gradient,) = torch.autograd.grad((blend(image.detach(), replace(psfs, **{part: leaf})) * other).sum(), leaf)
        change = torch.rand(leaf.shape, generator=torch.Generator().manual_seed(7))
        response = blend(image.detach(), replace(psfs, **{part: leaf.detach() + change})) - blend(image.detach(), psfs)
        assert float((gradient * change).sum()) == pytest.approx(float((response * other).sum()), rel=1e-3, abs=1e-3)


def test_light_of_the_halo_is_found_where_it_belongs():
    """With all light outside the window, a capture keeps sum and centre of mass and has no light near the star."""
    halo = torch.zeros(2, 2, 3, 9, 9)
    halo[..., 4, 0] = halo[..., 4, 8] = 0.5  # sixteen pixels to the left and to the right
    psfs = SensorPsfs((64, 64), f64([0, 31.5]), f64([0, 31.5]), torch.zeros(2, 2, 3, 3, 3), halo, halo_pixel=4)
    star = torch.zeros(3, 64, 64)
    star[:, 30:34, 30:34] = 1 / 16
    capture = blend(star, psfs)[0]
    columns = torch.arange(64.0) - 31.5
    assert float(capture.sum()) == pytest.approx(1, rel=1e-5)
    assert float((capture * columns).sum()) == pytest.approx(0, abs=0.6)
    assert float((capture * columns.abs()).sum()) == pytest.approx(16, abs=0.5)
    assert float(capture[:, 26:38].abs().max()) < 1e-6


def test_an_image_of_another_size_than_its_psfs_is_refused():
    with pytest.raises(InputError, match=r"\(3, 32, 47\).*expected \(3, 32, 48\)"):
        blend(torch.zeros(3, 32, 47), with_halo((32, 48), 6))
