"""The tracer in plain autograd: the laws of one surface, and the fast tracer against it in values and derivatives."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import WAVELENGTHS, assert_close, cooke_triplet, f64, make_lens, parallel_rays, random_lens, random_rays

from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, RayStatus, launch
from tasklens.optics.tracing.reference_tracer import reference_trace
from tasklens.optics.tracing.trace import trace

TRACERS = (trace, reference_trace)
VALUES = ("x", "y", "z", "l", "m", "n", "path")


SURFACES = random_lens(1).surfaces[1:]  # four aspheres with conics between -2 and 1 and coefficients up to alpha_10


def random_like(values: torch.Tensor, seed: int) -> torch.Tensor:
    return torch.randn(values.shape, generator=torch.Generator().manual_seed(seed), dtype=values.dtype)


def direction(rays: Rays) -> torch.Tensor:
    return torch.stack([rays.l, rays.m, rays.n], -1)


def position(rays: Rays) -> torch.Tensor:
    return torch.stack([rays.x, rays.y, rays.z], -1)


# ---- one surface


def test_rays_meet_the_surface_on_their_line():
    """The point is on the surface and on the line of the ray; the path is index times distance."""
    start = replace(random_rays(100, 0), z=f64(-0.3))
    start = launch(*(getattr(start, k) for k in "xyzlmn"))
    for surface in SURFACES:
        rays = surface.intersect(start, 1.5)
        assert rays.valid.all()
        assert_close(rays.z, surface.sag(rays.x, rays.y), 1e-15)
        way = position(rays) - position(start)
        assert_close(torch.linalg.cross(way, direction(start)), 0.0, 1e-15)
        assert_close(rays.path, 1.5 * (way * direction(start)).sum(-1), 1e-15)


@pytest.mark.parametrize("indices", [(1.0, 1.6), (1.6, 1.0)], ids=["into glass", "out of glass"])
def test_snells_law(indices):
    """n D x N = n' D' x N; D, N and D' lie in one plane; both rays are on their side of the surface; |D'| = 1."""
    for surface in SURFACES:
        before = surface.intersect(random_rays(100, 0))
        behind = surface.refract(before, *indices)
        assert behind.valid.all()
        normal = torch.stack(surface.normal(before.x, before.y), -1)
        n, n_behind = indices
        sines = [torch.linalg.cross(direction(rays), normal) for rays in (before, behind)]
        assert_close(n * sines[0] - n_behind * sines[1], 0.0, 1e-15)
        assert_close((sines[0] * direction(behind)).sum(-1), 0.0, 1e-15)
        assert ((direction(behind) * normal).sum(-1) > 0).all()
        assert_close(direction(behind).square().sum(-1), 1.0, 2e-15)
        assert torch.equal(position(behind), position(before))


# ---- whole lenses, the fast tracer compared with the reference


def vignetting_triplet() -> Lens:
    """The Cooke triplet with a stop inside and rims that cut oblique light."""
    return cooke_triplet(semi_diameter=f64([8.5, 8.5, 5.5, 5.5, 4.0, 6.0, 7.0, torch.inf, torch.inf]))


CASES = {
    "random": lambda: (random_lens(1), random_rays(200, 1)),
    "narrow": lambda: (
        replace(random_lens(0), semi_diameter=f64([0.3, 0.5, 0.5, 0.4, 0.5])),
        random_rays(200, 0, height=0.4, tangent=0.5),
    ),
    "steep": lambda: (random_lens(0), random_rays(200, 0, height=1.5, tangent=1.0)),
    "balls": lambda: (
        make_lens([0.0, 1.0, -1.0, 1.0, -1.0], [0.1] * 5, random_lens(0).media),
        random_rays(200, 3, height=1.5, tangent=0.5),
    ),
    "triplet": lambda: (vignetting_triplet(), random_rays(200, 0, height=8.0, tangent=0.3)),
    "near object": lambda: (vignetting_triplet(), rays_from(f64([0.0, -40.0, -200.0]))),
}


def rays_from(point: torch.Tensor) -> Rays:
    """(1, 41) rays from a point [mm] to heights up to 8 mm on the first vertex plane."""
    height = torch.linspace(-8, 8, 41, dtype=torch.float64)[None]
    way = torch.stack([torch.zeros_like(height), height, torch.zeros_like(height)]) - point[:, None, None]
    return launch(*point, *(way / way.norm(dim=0)))


def test_values():
    """The status of each ray and the surface where it was lost; position [mm], direction and path [mm] to 1e-12.

    The cases lose rays in every way, and the triplet in front of the stop, at the stop and behind it.
    """
    statuses, lost_at = set(), {}
    for name, case in CASES.items():
        lens, start = case()
        fast, reference = (tracer(lens, start, lens.refractive_indices(WAVELENGTHS)) for tracer in TRACERS)
        assert torch.equal(fast.status, reference.status) and torch.equal(fast.lost_at, reference.lost_at), name
        assert fast.valid.any()
        for value in VALUES:
            assert_close(getattr(reference, value), getattr(fast, value), 1e-12)
        statuses |= set(fast.status.flatten().tolist())
        lost_at[name] = set(fast.lost_at.flatten().tolist())
    assert statuses == set(RayStatus) and {0, 4, 5} <= lost_at["triplet"]


@pytest.mark.parametrize("tracer", TRACERS)
def test_a_ray_outside_that_would_be_reflected_is_outside(tracer):
    lens = make_lens([0.0, -0.8], [1.0, 1.0], ("COC", "air"), semi_diameter=[9.0, 0.5])
    rays = tracer(lens, parallel_rays([1.0]), lens.refractive_indices(WAVELENGTHS[:1]))
    assert (int(rays.status), int(rays.lost_at), float(rays.y)) == (RayStatus.VIGNETTED, 1, 1.0)


@pytest.mark.parametrize("tracer", TRACERS)
def test_a_ray_that_misses_stays_at_the_stop_before(tracer):
    lens = make_lens([0.0, 1.0], [0.5, 1.0], ("air", "COC"))
    start = launch(*f64([0.0, 2.0, -1.0, 0.0, 0.6, 0.8]).reshape(6, 1, 1))
    rays = tracer(lens, start, lens.refractive_indices(WAVELENGTHS[:1]))
    assert (int(rays.status), int(rays.lost_at)) == (RayStatus.MISSED, 1)
    assert_close(rays.y, 2.75, 1e-15)


# ---- derivatives


def parameters(lens: Lens, start: Rays) -> dict[str, torch.Tensor]:
    """Inputs with derivatives: the lens, the indices, and the start of the rays."""
    values = {name: getattr(lens, name) for name in ("curvature", "conic", "alpha", "thickness")}
    return values | {"indices": lens.refractive_indices(WAVELENGTHS)} | {k: getattr(start, k) for k in VALUES}


def outputs_of(tracer, lens: Lens, start: Rays, values: dict[str, torch.Tensor]) -> torch.Tensor:
    values = dict(values)
    indices = values.pop("indices")
    start = replace(start, **{k: values.pop(k) for k in VALUES})
    rays = tracer(replace(lens, **values), start, indices)
    return torch.stack([getattr(rays, name) for name in ("x", "y", "l", "m", "n", "path")])


DERIVED = ["random", "narrow", "steep", "triplet"]


@pytest.mark.parametrize("name", DERIVED)
def test_gradients(name):
    """Of a random combination of all outputs, lost rays included, by every input: to 1e-10 of the largest element."""
    lens, start = CASES[name]()
    values = parameters(lens, start)

    def combined(values, tracer):
        result = outputs_of(tracer, lens, start, values)
        return (random_like(result, 5) * result).sum()

    result, expected = (torch.func.grad(combined)(values, tracer) for tracer in TRACERS)
    for key in values:
        if values[key].numel():  # the triplet has no alpha
            scale = float(expected[key].abs().max())
            assert scale > 0
            assert_close(result[key], expected[key], 1e-10 * scale)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "steep" else n for n in DERIVED])
def test_forward_mode(name):
    """Along random changes of the lens and its indices, and of all start values: to 1e-10 of the largest element."""
    lens, start = CASES[name]()
    values = parameters(lens, start)
    for of_start in (False, True):
        tangents = {k: random_like(v, i) * ((k in VALUES) == of_start) for i, (k, v) in enumerate(values.items())}
        actual, expected = (
            torch.func.jvp(partial(outputs_of, tracer, lens, start), (values,), (tangents,))[1] for tracer in TRACERS
        )
        assert_close(actual, expected, 1e-10 * float(expected.abs().max()))
