"""Aspheres and ray tracing: the laws of refraction, exact systems, gradients, and what becomes of lost rays."""

from dataclasses import replace

import pytest
import torch
from examples import WAVELENGTHS, assert_close, f64, make_lens, parallel_rays, random_lens, random_rays

from tasklens.materials.catalogues import builtin
from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens
from tasklens.optics.rays import RayStatus, launch
from tasklens.optics.tracing.reference import reference_trace
from tasklens.optics.tracing.trace import trace, trace_full

SEEDS = range(4)


def refractions(lens: Lens, seed: int):
    """Per surface: number, rays after it, points before and on it, directions before and after, normal, indices."""
    start = random_rays(100, seed)
    rays, record = trace_full(lens, start, lens.refractive_indices(WAVELENGTHS))
    assert rays.valid.all()
    z = f64([0.0, *lens.vertices.tolist()])
    before = start
    for i, after in enumerate(record):
        origin = torch.stack([before.x, before.y, before.z + z[i]], -1)
        point = torch.stack([after.x, after.y, after.z + lens.vertices[i]], -1)
        incoming = torch.stack([before.l, before.m, before.n], -1)
        outgoing = torch.stack([after.l, after.m, after.n], -1)
        normal = torch.stack(lens.surfaces[i].normal(after.x, after.y), -1)
        n = lens.refractive_indices(WAVELENGTHS)[i : i + 2, :, None, None]
        origin, incoming = origin.expand_as(point), incoming.expand_as(outgoing)
        yield i, after, origin, point, incoming, outgoing, normal, n[0], n[1]
        before = after


@pytest.mark.parametrize("seed", SEEDS)
def test_snells_law(seed):
    """n d x N = n' d' x N: the sines obey Snell, and d, N and d' lie in one plane on the right side of each other."""
    for *_, incoming, outgoing, normal, n_before, n_after in refractions(random_lens(seed), seed):
        sine_before, sine_after = (torch.linalg.cross(d, normal) for d in (incoming, outgoing))
        assert_close(n_before * sine_before - n_after * sine_after, 0.0, 1e-14)
        assert ((outgoing * normal).sum(-1) > 0).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_refracted_ray_lies_in_the_plane_of_incidence(seed):
    for *_, incoming, outgoing, normal, _n_before, _n_after in refractions(random_lens(seed), seed):
        assert_close((torch.linalg.cross(incoming, normal) * outgoing).sum(-1), 0.0, 1e-14)


@pytest.mark.parametrize("seed", SEEDS)
def test_rays_are_straight_and_meet_the_surfaces(seed):
    """Each point lies on its surface and on the line of its ray; directions have unit length."""
    lens = random_lens(seed)
    for i, rays, origin, point, incoming, outgoing, *_ in refractions(lens, seed):
        assert_close(rays.z, lens.surfaces[i].sag(rays.x, rays.y), 2e-14)
        assert_close(torch.linalg.cross(point - origin, incoming), 0.0, 2e-14)
        assert_close(outgoing.square().sum(-1), 1.0, 4e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_malus_and_dupin(seed):
    """Rays stay normal to their wavefronts: d(path) = n' d' . dp' - n d . dp for every change of the launch point."""
    lens, start = random_lens(seed), random_rays(50, seed)
    shift = f64([0.6, -0.8])

    def image(x, y):
        rays = trace(lens, replace(start, x=x, y=y), lens.refractive_indices(WAVELENGTHS))
        return rays.x, rays.y, rays.path, rays.l, rays.m

    values, tangents = torch.func.jvp(
        image, (start.x, start.y), (shift[0].expand_as(start.x), shift[1].expand_as(start.y))
    )
    dx, dy, dpath = tangents[:3]
    valid = trace(lens, start, lens.refractive_indices(WAVELENGTHS)).valid
    assert valid.double().mean() > 0.9
    residual = dpath - (values[3] * dx + values[4] * dy) + (start.l * shift[0] + start.m * shift[1])
    assert_close(residual[valid], 0.0, 1e-13)


def test_flat_plate_shifts_and_does_not_turn():
    """A plane plate leaves directions alone and shifts a ray by t (tan i - tan i')."""
    t, back = 1.3, 0.7
    lens = make_lens([0.0, 0.0], [t, back], ("COC", "air"))
    start = random_rays(50, 0)
    rays = trace(lens, start, lens.refractive_indices((0.5893,)))
    assert_close(rays.l - start.l, 0.0, 1e-15)
    assert_close(rays.m - start.m, 0.0, 1e-15)
    n = builtin("COC").refractive_index(0.5893)
    inside = torch.sqrt(1 - (start.l**2 + start.m**2) / n**2)
    assert_close(rays.x - start.x - t * start.l / n / inside - back * start.l / start.n, 0.0, 2e-15)


def test_ellipsoid_focuses_collimated_light():
    """A surface of conic -1 / n^2 images a distant axial point without aberration at n R / (n - 1), on equal paths."""
    n, radius = builtin("PMMA").refractive_index(0.5893), 2.5
    lens = make_lens([1 / radius], [n * radius / (n - 1)], ("PMMA",), conic=[-1 / n**2])
    heights = torch.linspace(-1.5, 1.5, 31)
    rays = trace(lens, parallel_rays(heights), lens.refractive_indices((0.5893,)))
    assert rays.valid.all()
    assert_close(rays.y, 0.0, 5e-15)
    assert_close(rays.path, n * lens.thickness[0], 1e-14)


@pytest.mark.parametrize("seed", SEEDS)
def test_slope_is_the_derivative_of_the_sag(seed):
    lens = random_lens(seed)
    r = torch.linspace(0, 1.2, 30, dtype=torch.float64, requires_grad=True)
    for i in range(1, 5):
        surface = lens.curvature[i], lens.conic[i], lens.alpha[i]
        value, slope, inside = sag(r * r, *surface)
        assert inside.all()
        u = (r * r).detach().requires_grad_()
        assert_close(slope, torch.autograd.grad(sag(u, *surface)[0].sum(), u)[0], 1e-14)
        assert_close(radial_slope(r, *surface), torch.autograd.grad(value.sum(), r)[0], 1e-14)


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


def test_total_internal_reflection_begins_at_the_critical_angle():
    """Leaving glass through a sphere at height r, sin i = r / R: light passes while that is below 1 / n."""
    lens = make_lens([0.0, -0.8], [1.0, 1.0], ("COC", "air"))
    critical = 1 / builtin("COC").refractive_index(0.5893) / 0.8
    assert status_of(lens, parallel_rays([critical - 1e-3])) == (RayStatus.OK, -1)
    assert status_of(lens, parallel_rays([critical + 1e-3])) == (RayStatus.TOTAL_INTERNAL_REFLECTION, 1)


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
    [(0.0, trace), (0.5, trace), (5.0, trace), (1e5, trace), (0.5, reference_trace)],
    ids=lambda value: getattr(value, "__name__", f"tangent{value}"),
)
def test_nothing_is_ever_nan(name, tangent, tracer):
    """Whatever becomes of a ray, values and gradients are finite, in both modes."""
    lens = extreme_lenses()[name]
    values = {key: getattr(lens, key).clone().requires_grad_() for key in PARAMETERS}
    start = random_rays(200, 3, height=1.5, tangent=tangent)

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
    zero, one = f64([[0.0]]), f64([[1.0]])
    rays = trace(
        random_lens(0), launch(zero, one / 10, zero, one, zero, zero), random_lens(0).refractive_indices((0.5893,))
    )
    assert RayStatus(int(rays.status)) == RayStatus.MISSED
    assert torch.isfinite(torch.stack([rays.x, rays.y, rays.path])).all()


def test_float32_follows_float64():
    """Single precision stays within 1e-5 mm of double precision."""
    lens, start = random_lens(1), random_rays(100, 1)
    single = {k: v.float() for k, v in vars(lens).items() if isinstance(v, torch.Tensor)}
    single_lens = replace(lens, **single)
    rays = trace(lens, start, lens.refractive_indices(WAVELENGTHS))
    start = launch(*(getattr(start, k).float() for k in "xyzlmn"))
    single_rays = trace(single_lens, start, single_lens.refractive_indices(WAVELENGTHS))
    assert single_rays.x.dtype == torch.float32 and single_rays.valid.all()
    assert_close(single_rays.x.double() - rays.x, 0.0, 1e-5)
    assert_close(single_rays.y.double() - rays.y, 0.0, 1e-5)
