"""Rays meet a surface at their first crossing, or are missed: compared with a dense scan along each ray."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
from examples import WAVELENGTHS, f64, make_lens
from reference_lenses import LENS_FILES, reference_lens, reference_view

from tasklens.optics import aspheres
from tasklens.optics.analysis.pupil import launch_fields, sobol_disc
from tasklens.optics.lens import Lens
from tasklens.optics.rays import GRAZING, Rays, RayStatus, launch
from tasklens.optics.surface import Surface
from tasklens.optics.tracing.reference_tracer import reference_trace
from tasklens.optics.tracing.trace import trace, trace_full

SAMPLES = 1000


def profile(surface: Surface, u: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Sag by the textbook sum, and a mask of where it is defined."""
    c, k, alpha = float(surface.curvature), float(surface.conic), surface.alpha.tolist()
    argument = 1 - (1 + k) * c * c * u
    value = c * u / (1 + numpy.sqrt(numpy.maximum(argument, 0)))
    return value + sum(a * u**j for j, a in enumerate(alpha, 1)), argument > aspheres.EDGE


def scan(surface: Surface, point: numpy.ndarray, direction: numpy.ndarray, reach: float) -> tuple[float, float]:
    """The first two samples (along the ray, signed) between which a ray crosses from its side, NaN without any.

    The scan starts at the ray's point, or at the edge if the point is not above the surface; it goes forward before
    the surface and backward behind it.
    """

    def gap(t):
        x, y, z = (p + t * w for p, w in zip(point, direction, strict=True))
        sag, inside = profile(surface, x * x + y * y)
        return numpy.where(inside, z - sag, numpy.nan)

    for side in (1.0, -1.0):
        t = side * numpy.linspace(0, reach, SAMPLES)
        along = gap(t)
        above = numpy.flatnonzero(~numpy.isnan(along))
        if not len(above) or along[above[0]] * side > 0:
            continue
        leaves = above[0] + numpy.flatnonzero(numpy.isnan(along[above[0] :]))
        piece = along[above[0] : leaves[0] if len(leaves) else None]
        crossed = numpy.flatnonzero(piece * side > 0)
        if not len(crossed):
            return math.nan, math.nan
        k = above[0] + crossed[0]
        return t[k - 1], t[k]
    return math.nan, math.nan


def assert_first(surface: Surface, before: Rays, after: Rays, reach: float) -> tuple[int, int]:
    """Every ray (N,) meets the surface, at the scanned crossing or earlier. Return the counts met, missed."""
    count = 0
    numbers = {k: getattr(before, k).flatten().numpy() for k in "xyzlmn"}
    points = {k: getattr(after, k).flatten().numpy() for k in "xyz"}
    missed = (after.status.flatten() == RayStatus.MISSED).numpy()
    for i in range(len(missed)):
        point, direction = numpy.array([numbers[k][i] for k in "xyz"]), numpy.array([numbers[k][i] for k in "lmn"])
        last, first = scan(surface, point, direction, reach)
        if missed[i]:
            assert math.isnan(first) or grazes(surface, point, direction, last, first), (i, point, direction, first)
            continue
        count += 1
        crossing = numpy.array([points[k][i] for k in "xyz"])
        t = float((crossing - point) @ direction)
        sag, inside = profile(surface, numpy.array(crossing[0] ** 2 + crossing[1] ** 2))
        assert inside and abs(crossing[2] - sag) < 1e-11 * max(1.0, reach), (i, point, direction)
        assert math.isnan(first) or abs(t) <= abs(first) + 1e-9, (i, point, direction, t, first)
    return count, int(missed.sum())


def grazes(surface: Surface, point, direction, last: float, first: float) -> bool:
    """Return whether the ray crosses the surface between the samples at an angle that no tracer can tell from zero."""
    t = f64(numpy.linspace(last, first, 1000))
    x, y = point[0] + t * direction[0], point[1] + t * direction[1]
    slope = aspheres.sag(x * x + y * y, surface.curvature, surface.conic, surface.alpha)[1]
    return bool((direction[2] - 2 * slope * (x * direction[0] + y * direction[1])).min() < 10 * GRAZING)


@pytest.mark.parametrize("path", LENS_FILES, ids=lambda path: path.stem)
def test_published_lenses(path):
    """Every ray of three fields at every surface, inside and outside the clear apertures."""
    lens, view = reference_lens(path), reference_view(path, (0.0, 0.7, 1.0)).in_reference()
    start = launch_fields(lens, view, sobol_disc(8, seed=1))
    _, record = trace_full(lens, start, lens.refractive_indices(view.wavelengths_um))
    reach = 2 * float(lens.thickness.abs().max()) + 2 * float(lens.semi_diameter[lens.stop])
    before, count = start, 0
    for i, surface in enumerate(lens.surfaces):
        after = record[i]
        arriving = (before.status == 0).flatten()
        if bool(arriving.any()):
            part = [
                Rays(*(v.expand(after.x.shape).flatten()[arriving] for v in vars(rays).values()))
                for rays in (before, after)
            ]
            count += assert_first(surface, *part, reach)[0]
        before = replace(after, z=after.z - lens.thickness[i])
    assert count > 8 * len(lens.media)


def random_surface(generator: torch.Generator) -> Lens:
    """A stop plane and one asphere behind it, from gentle to wild, with a conic of any kind."""
    size, curvature, conic = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    orders = f64([0.2, 0.3, 0.3, 0.2, 0.1, 0.05]) * 4**size
    alpha = orders * torch.randn(6, generator=generator, dtype=torch.float64)
    return make_lens(
        [0.0, 2 * curvature - 1],
        [0.7, 1.0],
        ("air", "COC"),
        conic=[0.0, 6 * conic - 3],
        alpha=[[0.0] * 6, alpha.tolist()],
    )


@pytest.mark.parametrize("tracer, seeds", [(trace, range(4)), (reference_trace, (2,))])
def test_random_aspheres(tracer, seeds):
    """Steep rays to heights where the polynomials turn over: met and missed rays, and rays that cross several times."""
    all_missed = 0
    for seed in seeds:
        generator = torch.Generator().manual_seed(seed)
        lens = random_surface(generator)
        x, y, tx, ty, z = 2 * torch.rand(5, 1, 100, generator=generator, dtype=torch.float64) - 1
        n = torch.rsqrt(1 + tx**2 + ty**2)
        start = launch(1.2 * x, 1.2 * y, 0.3 * z, tx * n, ty * n, n)
        rays = tracer(lens, start, lens.refractive_indices(WAVELENGTHS[:1]))
        # Rays start on the stop plane; `after` has them on the asphere, before the image plane.
        before = lens.surfaces[0].intersect(start)
        before = replace(before, z=before.z - lens.thickness[0])
        after = lens.surfaces[1].intersect(before) if tracer is reference_trace else last_rays(lens, start)
        assert torch.equal(after.status == RayStatus.MISSED, rays.status == RayStatus.MISSED)
        met, missed = assert_first(lens.surfaces[1], before, after, reach=4.0)
        assert met > 20 and met + missed == 100
        all_missed += missed
    assert all_missed > 8 * len(seeds)


def last_rays(lens: Lens, start: Rays) -> Rays:
    return trace_full(lens, start, lens.refractive_indices(WAVELENGTHS[:1]))[1][-1]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_invalid_ray_changes_no_other(bad):
    """An invalid ray is lost at once, stays finite, and does not change the stop or other rays."""
    lens = make_lens([0.0, 0.5], [0.5, 1.0], ("air", "COC"), semi_diameter=[0.4, math.inf])
    n = torch.ones(1, 200, dtype=torch.float64)
    x = torch.linspace(-0.8, 0.8, 200, dtype=torch.float64)[None]
    indices = lens.refractive_indices(WAVELENGTHS)
    plain = trace(lens, launch(x, 0 * x, 0 * x, 0 * x, 0 * x, n), indices)
    spoilt = n.clone()
    spoilt[0, 17] = bad
    for name, spoil in {"n": spoilt, "x": x * spoilt, "l": spoilt - 1}.items():
        numbers = {"x": x, "y": 0 * x, "z": 0 * x, "l": 0 * x, "m": 0 * x, "n": n, name: spoil}
        rays = trace(lens, launch(**numbers), indices)
        others = torch.arange(200) != 17
        assert torch.equal(rays.status[:, others], plain.status[:, others]), name
        assert torch.equal(rays.x[:, others], plain.x[:, others])
        assert (rays.status[:, 17] != 0).all()
    assert {int(v) for v in plain.status.unique()} == {RayStatus.OK, RayStatus.VIGNETTED}


@pytest.mark.parametrize("tracer", [trace, reference_trace])
def test_a_crossing_between_two_starts_that_are_beyond_the_surface(tracer):
    """Surface 9 of US 9,201,216 B2: on this ray vertex plane and base conic are outside the asphere's domain."""
    path = next((path for path in LENS_FILES if path.stem == "US9201216B2"), None)
    if path is None:
        pytest.skip("this lens is not distributed")
    surface = reference_lens(path).surfaces[9]
    conic, alpha = f64([0.0, 1.0]) * surface.conic, f64([[0.0], [1.0]]) * surface.alpha
    lens = make_lens(f64([0.0, 1.0]) * surface.curvature, [0.43576, 1.0], ("air", "COC"), conic=conic, alpha=alpha)
    start = launch(*f64([-0.46101, 0.81768, 0.0, 0.22995, 0.65083, 0.72356]).reshape(6, 1, 1))
    before = replace(start, z=start.z - lens.thickness[0])
    assert float(lens.surfaces[1].intersect(before).path) == pytest.approx(0.2874, abs=1e-4)
    assert int(tracer(lens, start, f64([[1.0], [1.0], [1.53]])).status) != RayStatus.MISSED
