"""Aspheres and ray tracing: the laws of refraction, exact systems, gradients, and what becomes of lost rays."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, assert_close, f64, make_lens, parallel_rays, random_lens, random_rays

from tasklens.materials.catalogues import builtin
from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens
from tasklens.optics.rays import RayStatus, launch
from tasklens.optics.tracing.reference_tracer import reference_trace
from tasklens.optics.tracing.trace import trace


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


def test_a_lost_ray_stays_lost_and_does_not_disturb_others():
    """Rays are traced as if alone, and a status once decided survives all later surfaces."""
    lens = make_lens([0.0, 1.0, 0.0], [0.5, 0.5, 1.0], ("air", "COC", "air"), semi_diameter=[0.9, 9.0, 0.5])
    indices, heights = lens.refractive_indices((0.5893,)), [0.1, 0.95, 0.8, -0.3]
    together = trace(lens, parallel_rays(heights), indices)
    assert together.lost_at.tolist() == [[-1, 0, 2, -1]]
    for k, height in enumerate(heights):
        alone = trace(lens, parallel_rays([height]), indices)
        for name in ("x", "y", "path", "status"):
            assert_close(getattr(together, name)[0, k], getattr(alone, name)[0, 0], 0.0)


def extreme_lenses() -> dict[str, Lens]:
    steep = random_lens(0)
    return {
        "flat": make_lens([0.0] * 5, [0.5] * 5, steep.media, alpha=torch.zeros(5, 5)),
        "steep": replace(steep, curvature=4 * steep.curvature, alpha=20 * steep.alpha),
        "overlapping": replace(steep, thickness=f64([0.1, -0.4, 0.0, -0.2, 1.0])),
        "half balls": make_lens([0.0, 1.0, -1.0, 1.0, -1.0], [0.1] * 5, steep.media),
    }


PARAMETERS = ("curvature", "conic", "alpha", "thickness")


@pytest.mark.parametrize("name", extreme_lenses())
@pytest.mark.parametrize(
    "tangent, tracer",
    [(0.5, trace), (1e5, trace), (0.5, reference_trace)],
    ids=["fast", "fast and steep", "reference"],
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
