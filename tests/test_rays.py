"""Ray tracing: what becomes of lost rays, scaled lenses, derivatives of the tracer, threads."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, assert_close, f64, make_lens, parallel_rays, random_lens, random_rays

from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.aspheres import sag
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, RayStatus, launch
from tasklens.optics.tracing.reference_tracer import reference_trace
from tasklens.optics.tracing.trace import linearise, trace
from tasklens.runtime.errors import InputError


def test_sag_beyond_the_edge_of_the_conic_is_finite():
    """Where the sphere ends the mask says so, and neither values nor gradients become infinite."""
    values = [f64(v).requires_grad_() for v in (1.0, 0.0, [0.1, 0.2])]
    u = f64([0.5, 1.0, 1.5, 100.0]).requires_grad_()
    value, slope, inside = sag(u, *values)
    assert inside.tolist() == [True, False, False, False]
    gradients = torch.autograd.grad((value + slope).sum(), [u, *values])
    assert all(torch.isfinite(t).all() for t in (value, slope, *gradients))


def status_of(lens: Lens, rays) -> tuple[RayStatus, int]:
    """Status of a ray and the surface that it is lost at, the same in both tracers."""
    fast, slow = (tracer(lens, rays, lens.refractive_indices((0.5893,))) for tracer in (trace, reference_trace))
    assert (int(fast.status), int(fast.lost_at)) == (int(slow.status), int(slow.lost_at))
    return RayStatus(int(fast.status)), int(fast.lost_at)


def test_a_lost_ray_has_a_status_and_a_surface():
    """A ray that misses, hits the mount or is totally internally reflected says so, with the surface."""
    ball = make_lens([0.0, 1.0, 0.0], [0.5, 0.5, 1.0], ("air", "COC", "air"))
    assert status_of(ball, parallel_rays([1.5])) == (RayStatus.MISSED, 1)
    assert status_of(ball, parallel_rays([0.4])) == (RayStatus.OK, -1)
    mount = replace(ball, semi_diameter=f64([9.0, 9.0, 0.3]))
    assert status_of(mount, parallel_rays([0.6])) == (RayStatus.VIGNETTED, 2)
    assert status_of(mount, parallel_rays([0.2])) == (RayStatus.OK, -1)
    stop = replace(ball, semi_diameter=f64([0.3, 9.0, 9.0]))
    assert status_of(stop, parallel_rays([0.3 * (1 - 1e-9)])) == (RayStatus.OK, -1)
    assert status_of(stop, parallel_rays([0.3 * (1 + 1e-5)])) == (RayStatus.VIGNETTED, 0)
    sphere = make_lens([0.0, -0.8], [1.0, 1.0], ("COC", "air"))  # total reflection begins at sin i = r / R = 1 / n
    critical = 1 / builtin("COC").refractive_index(0.5893) / 0.8
    assert status_of(sphere, parallel_rays([critical - 1e-3])) == (RayStatus.OK, -1)
    assert status_of(sphere, parallel_rays([critical + 1e-3])) == (RayStatus.TOTAL_INTERNAL_REFLECTION, 1)


@pytest.mark.parametrize("factor, seed", [(0.3, 0), (7.0, 1)])
def test_a_scaled_lens_has_scaled_rays(factor, seed):
    """Points, paths, clear apertures and focal length grow with the lens; directions and lost rays are the same."""
    lens = replace(random_lens(seed), semi_diameter=f64([0.4, 0.5, torch.inf, 0.6, torch.inf]))
    rays = random_rays(300, seed)
    indices = lens.refractive_indices((0.5893,))
    small = trace(lens, rays, indices)
    large = trace(lens.scaled(factor), replace(rays, x=factor * rays.x, y=factor * rays.y), indices)
    assert 0 < small.valid.double().mean() < 1
    assert torch.equal(large.status, small.status) and torch.equal(large.lost_at, small.lost_at)
    for name in ("x", "y", "path"):
        torch.testing.assert_close(getattr(large, name), factor * getattr(small, name), rtol=1e-12, atol=1e-12 * factor)
    for name in ("l", "m", "n"):
        torch.testing.assert_close(getattr(large, name), getattr(small, name), rtol=0, atol=1e-12)
    before, after = paraxial(lens, 0.5893), paraxial(lens.scaled(factor), 0.5893)
    for name in ("efl", "bfl", "entrance_pupil_z", "entrance_pupil_radius"):
        assert float(getattr(after, name)) == pytest.approx(factor * float(getattr(before, name)), rel=1e-12)


def extreme_lenses() -> dict[str, Lens]:
    steep = random_lens(0)
    return {
        "flat": make_lens([0.0] * 5, [0.5] * 5, steep.media, alpha=torch.zeros(5, 5)),
        "steep": replace(steep, curvature=4 * steep.curvature, alpha=20 * steep.alpha),
        "overlapping": replace(steep, thickness=f64([0.1, -0.4, 0.0, -0.2, 1.0])),
        "half balls": make_lens([0.0, 1.0, -1.0, 1.0, -1.0], [0.1] * 5, steep.media),
    }


PARAMETERS = ("curvature", "conic", "alpha", "thickness")


@pytest.mark.parametrize(
    "name, tangent, tracer",
    [(name, tangent, trace) for name in extreme_lenses() for tangent in (0.5, 1e5)]
    + [("half balls", 0.5, reference_trace)],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_nothing_is_ever_nan(name, tangent, tracer):
    """Whatever becomes of a ray, values and gradients are finite, in both modes."""
    lens = extreme_lenses()[name]
    values = {key: getattr(lens, key).clone().requires_grad_() for key in PARAMETERS}
    start = random_rays(60, 3, height=1.5, tangent=tangent)

    def image(parameters):
        rays = tracer(replace(lens, **parameters), start, lens.refractive_indices(WAVELENGTHS))
        return torch.stack([rays.x, rays.y, rays.l, rays.m, rays.n, rays.path])

    result = image(values)
    assert torch.isfinite(result).all()
    gradients = torch.autograd.grad(result.sum(), list(values.values()), allow_unused=True)
    assert all(torch.isfinite(g).all() for g in gradients if g is not None)
    derivatives = torch.func.jvp(image, (values,), ({k: torch.ones_like(v) for k, v in values.items()},))[1]
    assert torch.isfinite(derivatives).all()


def test_a_ray_that_never_moves_along_the_axis_is_missed_and_finite():
    lens, zero, one = random_lens(0), f64([[0.0]]), f64([[1.0]])
    rays = trace(lens, launch(zero, one / 10, zero, one, zero, zero), lens.refractive_indices((0.5893,)))
    assert RayStatus(int(rays.status)) == RayStatus.MISSED
    assert torch.isfinite(torch.stack([rays.x, rays.y, rays.path])).all()


def image_of(lens: Lens, **parameters):
    """A fixed random combination of image points, directions and paths; it depends on every parameter and index."""
    indices = parameters.pop("indices", lens.refractive_indices(WAVELENGTHS))
    rays = trace(replace(lens, **parameters), random_rays(20, 7), indices)
    weights = torch.randn(4, *rays.x.shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    return (weights * torch.stack([rays.x, rays.y, rays.l, rays.path])).sum()


@pytest.mark.parametrize("name", [*PARAMETERS, "indices"])
def test_second_derivatives_are_refused(name):
    """In both modes: first derivatives are computed without a graph, and so second ones would be zero."""
    lens = random_lens(0)
    value = lens.refractive_indices(WAVELENGTHS) if name == "indices" else getattr(lens, name)
    leaf, along = value.clone().requires_grad_(), torch.ones_like(value)
    (gradient,) = torch.autograd.grad(image_of(lens, **{name: leaf}), leaf, create_graph=True)
    with pytest.raises(InputError, match="second derivatives"):
        torch.autograd.grad(gradient.sum(), leaf)

    def slope(value):
        return torch.func.jvp(lambda v: image_of(lens, **{name: v}), (value,), (along,))[1]

    with pytest.raises(InputError, match="second derivatives"):
        torch.func.jvp(slope, (value,), (along,))


def test_linearised_rays_change_as_derivatives_say():
    """Two changes of the lens at once, each through all of its parameters, against one after the other."""
    lens, start = random_lens(4), random_rays(12, 5)
    start = replace(start, **{k: getattr(start, k)[:, None] for k in vars(start)})
    indices = lens.refractive_indices(WAVELENGTHS[:1])
    values = {name: getattr(lens, name) for name in PARAMETERS}
    generator = torch.Generator().manual_seed(6)
    changes = {k: torch.randn(2, *v.shape, generator=generator, dtype=v.dtype) for k, v in values.items()}

    def image(values):
        rays = trace(replace(lens, **values), start, indices)
        return torch.stack([rays.x, rays.y, rays.l, rays.m, rays.n])

    rays, _, derivative = linearise(lens, start, indices)
    assert torch.equal(torch.stack([rays.x, rays.y, rays.l, rays.m, rays.n]), image(values))
    image_changes = torch.stack(derivative(changes).image, 1)
    for i in range(2):
        expected = torch.func.jvp(image, (values,), ({k: v[i] for k, v in changes.items()},))[1]
        assert_close(image_changes[i], expected, 1e-11)
    alone = derivative({"conic": changes["conic"]}).image[0]
    assert_close(derivative({"conic": changes["conic"], "thickness": 0 * changes["thickness"]}).image[0], alone, 0.0)


def test_threads_and_blocks_do_not_show(two_threads):
    """Ten thousand rays in one thread and in two, and in parts that split a block: the same bits, sums to rounding."""
    lens, start = random_lens(2), random_rays(10_000, 3)

    def traced(first, last, threads=1):
        torch.set_num_threads(threads)
        leaf = lens.curvature.clone().requires_grad_()
        part = Rays(*(v[:, first:last] for v in vars(start).values()))
        rays = trace(replace(lens, curvature=leaf), part, lens.refractive_indices(WAVELENGTHS))
        return torch.stack([rays.x, rays.y, rays.path]), torch.autograd.grad(rays.x.square().sum(), leaf)[0]

    whole, parts = traced(0, 10_000), [traced(0, 777), traced(777, 10_000)]
    for actual, expected in zip(traced(0, 10_000, threads=2), whole, strict=True):
        assert_close(actual, expected, 0.0)
    assert_close(torch.cat([part[0] for part in parts], -1), whole[0], 1e-15)
    assert_close(sum(part[1] for part in parts), whole[1], 1e-12 * float(whole[1].abs().max()))


def test_a_lost_ray_carries_no_gradient():
    """The stop passes one of two rays: the gradient of both image points equals that of the one."""
    lens = replace(random_lens(0), semi_diameter=f64([0.3, *[torch.inf] * 4]))

    def gradient(heights):
        leaf = lens.curvature.clone().requires_grad_()
        rays = trace(replace(lens, curvature=leaf), parallel_rays(heights), lens.refractive_indices((0.5893,)))
        return rays, torch.autograd.grad(rays.y.sum() + rays.path.sum(), leaf)[0]

    rays, both = gradient([0.2, 0.4])
    assert rays.lost_at.tolist() == [[-1, 0]] and float(rays.y[0, 1].detach()) == 0.4
    assert_close(both, gradient([0.2])[1], 0.0)
