"""Decentred and tilted surfaces and elements: laws and derivatives; rays to 40 digits are in test_reference_rays."""

from dataclasses import replace
from functools import partial

import torch
from examples import HEADLINE, WAVELENGTHS, assert_close, difference, f64, random_lens, random_rays

import tasklens
from tasklens.optics.analysis.aberrations import field_curvature
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import chief_points, ray_fans
from tasklens.optics.lens import Lens, Pose
from tasklens.optics.rays import Rays
from tasklens.optics.tracing.reference_tracer import reference_trace
from tasklens.optics.tracing.trace import linearise, trace


def random_pose(seed: int) -> Lens:
    """A lens with every surface decentred and tilted, and two of them once more as an element."""
    generator = torch.Generator().manual_seed(seed)
    lens = random_lens(seed)
    for i in range(5):
        decentre, tilt = 0.02 * torch.randn(2, 2, generator=generator, dtype=torch.float64)
        lens = lens.with_surface_moved(i, decentre, tilt)
    return lens.with_element_moved(1, 2, f64([0.01, -0.02]), f64([-0.01, 0.03]))


def test_nominal_poses_change_nothing():
    """To rounding; moving the whole lens with its rays changes nothing either, up to the image plane, which stays."""
    lens, start = random_lens(1), random_rays(300, 1)
    indices = lens.refractive_indices(WAVELENGTHS)
    plain = trace(lens, start, indices)
    posed = trace(replace(lens, pose=Pose.nominal(5, torch.float64)), start, indices)
    shifted = lens.with_element_moved(0, 4, f64([0.1, -0.2]), f64([0.0, 0.0]))
    along = trace(shifted, replace(start, x=start.x + 0.1, y=start.y - 0.2), indices)
    assert_close(posed.x, plain.x, 1e-15)
    assert_close(along.x - 0.1, plain.x, 1e-14)
    assert_close(along.y + 0.2, plain.y, 1e-14)
    assert torch.equal(posed.status, plain.status)


def image(lens: Lens, start: Rays, indices, tracer, values) -> torch.Tensor:
    decentre, tilt, curvature = values["decentre"], values["tilt"], values["curvature"]
    lens = replace(lens, curvature=curvature).with_surface_moved(3, decentre, tilt)
    lens = lens.with_element_moved(1, 2, 2 * tilt, decentre)
    rays = tracer(lens, start, indices)
    return torch.stack([rays.x, rays.y, rays.l, rays.m, rays.n, rays.path])


def test_derivatives_by_decentre_and_tilt():
    """Reverse mode against differences; forward mode against reverse mode and the reference."""
    lens, start = random_pose(2), random_rays(40, 5)
    indices = lens.refractive_indices(WAVELENGTHS)
    generator = torch.Generator().manual_seed(3)
    values = {"decentre": f64([0.01, 0.02]), "tilt": f64([-0.02, 0.01]), "curvature": lens.curvature}
    function = partial(image, lens, start, indices, trace)
    weights = torch.randn(function(values).shape, generator=generator, dtype=torch.float64)
    gradient = torch.func.grad(lambda v: (weights * function(v)).sum())(values)
    for name, value in values.items():
        expected = difference(lambda v: (weights * function(values | {name: v})).sum(), value, 1e-3)  # noqa: B023
        torch.testing.assert_close(gradient[name], expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))
    changes = {k: torch.randn(v.shape, generator=generator, dtype=torch.float64) for k, v in values.items()}
    along = torch.func.jvp(function, (values,), (changes,))[1]
    slow = torch.func.jvp(partial(image, lens, start, indices, reference_trace), (values,), (changes,))[1]
    assert_close(along, slow, 1e-10 * float(slow.abs().max()))
    assert_close((weights * along).sum(), sum((gradient[k] * changes[k]).sum() for k in values), 1e-9)


def test_a_posed_lens_can_be_linearised():
    """Along its other parameters, as without a pose."""
    lens, start = random_pose(0), random_rays(40, 1)
    indices = lens.refractive_indices(WAVELENGTHS)
    change = torch.randn(5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    actual = linearise(lens, start, indices).derivative({"curvature": change[None]}).image[0][0]
    expected = torch.func.jvp(
        lambda c: trace(replace(lens, curvature=c), start, indices).x, (lens.curvature,), (change,)
    )[1]
    assert_close(actual, expected, 1e-13)


def test_a_lens_keeps_its_poses():
    """When it is detached, and scaled, where displacements grow with the lens."""
    lens = random_pose(0)
    start = random_rays(20, 1)
    indices = lens.refractive_indices(WAVELENGTHS)
    assert torch.equal(trace(lens.detached(), start, indices).x, trace(lens, start, indices).x)
    large = trace(lens.scaled(3.0), replace(start, x=3 * start.x, y=3 * start.y), indices)
    assert_close(large.x, 3 * trace(lens, start, indices).x, 1e-13)


def test_analyses_in_the_meridian_are_those_of_the_nominal_lens():
    """A field turned onto +y would be another field of a tilted lens."""
    lens, view = tasklens.load_lens(HEADLINE / "doublet-tasklens.yaml")
    moved = lens.with_element_moved(1, 2, f64([0.01, 0.0]), f64([0.0, 0.01]))
    torch.testing.assert_close(relative_illumination(moved, view), relative_illumination(lens, view), rtol=0, atol=0)
    for one, other in zip(field_curvature(moved, view), field_curvature(lens, view), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert torch.equal(ray_fans(moved, view, 5)[1], ray_fans(lens, view, 5)[1])
    assert not torch.equal(chief_points(moved, view), chief_points(lens, view))
