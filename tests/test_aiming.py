"""Rays aimed at a stop inside the lens: exact, differentiable, and lost if they cannot reach the stop."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import WAVELENGTHS, assert_derivative, cooke_triplet, difference, f64, make_lens, random_lens, view_at
from prescriptions import TENSORS, tensors
from reference_lenses import INNER_STOPS, LENS_FILES, reference_lens, reference_view

from tasklens.materials.material import model_glass
from tasklens.optics.analysis import aiming, pupil
from tasklens.optics.analysis.continuation import stop_is_curved
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields, rim, sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields
from tasklens.optics.lens import Lens, Melt
from tasklens.optics.rays import Rays, RayStatus, launch
from tasklens.optics.tracing.trace import trace, trace_full

CENTRE = torch.zeros(1, 2, dtype=torch.float64)
FEW = torch.cat([CENTRE, rim(16), sobol_disc(64, seed=1)])  # solved ray by ray
MANY = torch.cat([CENTRE, rim(64), sobol_disc(448, seed=2)])  # started by a polynomial
# Rays on a stop of this size are totally reflected in the first element at the full field of these lenses.
TOO_WIDE = {"ef35mm_f2.0": 0.8, "ef85mm_f1.8": 0.9}


def reverse_telephoto() -> Lens:
    """A negative meniscus far in front of the stop, and a positive group: its pupil wanders far with the field."""
    glass = model_glass(1.62, 60.0, 0.0)
    stop = [torch.inf, torch.inf, 0.8, torch.inf, torch.inf]
    media = (glass, "air", "air", glass, "air")
    spaces, alpha = [1.5, 12, 0.3, 3, 12], torch.zeros(5, 2)
    return make_lens([1 / 20, 1 / 8, 0, 1 / 20, -1 / 6], spaces, media, alpha=alpha, semi_diameter=stop, stop=2)


def curved_stop() -> Lens:
    """A triplet whose stop is an asphere, the front of its second element."""
    lens = cooke_triplet(stop=2, semi_diameter=f64([torch.inf] * 2 + [4.0] + [torch.inf] * 6))
    return replace(lens, alpha=1e-5 * torch.ones(9, 2, dtype=torch.float64), conic=0.1 * torch.ones(9).double())


def tangents_of(*degrees: float) -> torch.Tensor:
    """Fields across the diagonal of the sensor."""
    return f64([[0.6 * math.tan(math.radians(a)), -0.8 * math.tan(math.radians(a))] for a in degrees])


in_colours = partial(view_at, wavelengths=WAVELENGTHS)


def assert_on_stop(lens: Lens, rays: Rays, points: torch.Tensor, wavelengths: tuple[float, ...]) -> None:
    """Aimed rays pass the real stop at the points, including rays that are lost behind it."""
    image, behind = trace_full(lens, rays, lens.refractive_indices(wavelengths))
    stop_rays, aimed = behind[lens.stop], rays.valid
    assert not (aimed & (image.lost_at >= 0) & (image.lost_at <= lens.stop)).any()
    expected = (points * lens.semi_diameter[lens.stop]).expand(*aimed.shape, 2)
    # A ray that is lost behind the stop, or reflected at it, is still recorded where it met it.
    stop_points = torch.stack([stop_rays.x, stop_rays.y], -1)
    torch.testing.assert_close(stop_points[aimed], expected[aimed], rtol=0, atol=1e-12)


# ---- exact


@pytest.mark.parametrize("points", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("path", INNER_STOPS, ids=lambda path: path.stem)
def test_rays_hit_the_stop_at_their_pupil_points(path, points):
    """On the axis, at 0.7 and at the full field, in three colours, within 1e-12 mm."""
    lens, view = reference_lens(path), reference_view(path, (0.0, 0.7, 1.0))
    rays = launch_fields(lens, view, points)
    assert float(rays.valid.double().mean((1, 2)).min()) >= TOO_WIDE.get(path.stem, 1.0)
    assert_on_stop(lens, rays, points, view.wavelengths_um)


def curved_front() -> Lens:
    """An element whose front is the stop: rays meet it, not its vertex plane, at their pupil points."""
    media = (model_glass(1.6, 60.0, 0.0), "air")
    return make_lens([1 / 20, -1 / 60], [8.0, 25.0], media, conic=[-0.5, 0.0], semi_diameter=[9.0, torch.inf])


@pytest.mark.parametrize(
    "make, angles", [(reverse_telephoto, (0, 30, 50, 60, 70)), (curved_stop, (0, 10, 20)), (curved_front, (0, 5, 12))]
)
def test_stops_of_other_kinds(make, angles):
    """70 degrees off the axis the paraxial entrance pupil of a wide-angle lens misses the real one altogether."""
    lens, tangents = make(), tangents_of(*angles)
    for points in (FEW, MANY):
        rays = launch_fields(lens, in_colours(tangents), points)
        assert rays.valid.all() and trace(lens, rays, lens.refractive_indices(WAVELENGTHS)).valid.all()
        assert_on_stop(lens, rays, points, WAVELENGTHS)


@pytest.mark.parametrize("path", INNER_STOPS[:2], ids=lambda path: path.stem)
def test_rays_on_the_rim_pass_the_stop(path):
    """Also after rounding to single precision."""
    lens, view = reference_lens(path), reference_view(path, (0.0, 0.7))
    lens = replace(lens, **{name: value.float() for name, value in zip(TENSORS, tensors(lens), strict=True)})
    rays = launch_fields(lens, view, rim(16))
    assert rays.x.dtype == torch.float32
    image = trace(lens, rays, lens.refractive_indices(view.wavelengths_um))
    assert not (rays.valid & (image.lost_at >= 0) & (image.lost_at <= lens.stop)).any()


# ---- only if it is needed


def unaimed(lens: Lens, tangents: torch.Tensor, points: torch.Tensor, wavelengths: tuple[float, ...]) -> Rays:
    """Rays that fill the paraxial entrance pupil."""
    first_order = paraxial(lens, wavelengths[len(wavelengths) // 2])
    n = torch.rsqrt(1 + tangents.square().sum(-1))
    tx, ty = tangents[:, 0, None, None], tangents[:, 1, None, None]
    n = n[:, None, None].expand(len(tangents), len(wavelengths), len(points))
    x = points[:, 0] * first_order.entrance_pupil_radius - tx * first_order.entrance_pupil_z
    y = points[:, 1] * first_order.entrance_pupil_radius - ty * first_order.entrance_pupil_z
    return launch(x, y, torch.zeros_like(n), tx * n, ty * n, n)


def test_a_stop_in_front_changes_nothing(monkeypatch):
    """Plane stops as first surface, or behind planes in air: same bits, and no call of the solver."""
    monkeypatch.setattr(pupil, "aim", None)
    in_air = make_lens([0, 0, 0.1, -0.1], [1.0, 0.5, 2.0, 9.0], ("air", "air", "COC", "air"), stop=1)
    in_air.semi_diameter[1] = 0.7
    in_front = replace(random_lens(0), semi_diameter=f64([0.3, *[torch.inf] * 4]))
    front = [reference_lens(path) for path in LENS_FILES if not aiming.stop_is_inside(reference_lens(path))]
    plane = [lens for lens in front if not stop_is_curved(lens)]
    assert plane
    for lens in [in_front, in_air, *plane]:
        wavelengths = (0.4861327, 0.5875618, 0.6562725)
        expected = unaimed(lens, tangents_of(0, 2), FEW, wavelengths)
        rays = launch_fields(lens, view_at(tangents_of(0, 2), wavelengths=wavelengths), FEW)
        for name, value in vars(expected).items():
            assert torch.equal(getattr(rays, name), value), name


# ---- differentiable

PARAMETERS = ("curvature", "conic", "alpha", "thickness", "semi_diameter", "tangents", "pupil")


def image_points(make, name: str):
    """Image points of rays as a function of one parameter, and its value."""
    lens = make()
    tangents = tangents_of(10, 25)
    points = torch.cat([FEW[:2], 0.8 * FEW[20:22]])
    values = {"tangents": tangents, "pupil": points}
    value = values[name] if name in values else getattr(lens, name)
    if name == "semi_diameter":  # the others are infinite
        value = value[lens.stop : lens.stop + 1]

    def image(value: torch.Tensor) -> torch.Tensor:
        inputs = dict(values)
        changed = lens
        if name == "semi_diameter":
            radii = torch.full((len(lens.media),), torch.inf, dtype=torch.float64)
            changed = replace(lens, semi_diameter=torch.where(torch.arange(len(radii)) == lens.stop, value, radii))
        elif name in values:
            inputs[name] = value
        else:
            changed = replace(lens, **{name: value})
        rays = launch_fields(changed, in_colours(inputs["tangents"]), inputs["pupil"])
        # The rim of the stop is not an aperture here: a difference moves rays across it.
        opened = replace(changed, semi_diameter=torch.full_like(changed.curvature.detach(), torch.inf))
        rays = trace(opened, rays, changed.refractive_indices(WAVELENGTHS))
        assert rays.valid.all()
        return torch.stack([rays.x, rays.y])

    return image, value


@pytest.mark.parametrize(
    "make, name",
    [(reverse_telephoto, name) for name in PARAMETERS if name != "alpha"]
    + [(curved_stop, name) for name in ("curvature", "conic", "alpha")],
)
def test_derivatives_through_aiming(make, name):
    image, value = image_points(make, name)
    step = {"curvature": 1e-5, "alpha": 1e-8}.get(name, 1e-4)
    assert_derivative(image, value, step, seed=5, rtol=1e-7)


def test_derivatives_of_bundles_that_a_polynomial_starts():
    """Derivative of a sum over many rays with respect to all curvatures, spaces and glass melts at once."""
    lens = reverse_telephoto()
    generator = torch.Generator().manual_seed(6)
    names = ("curvature", "thickness", "shift")
    directions = {name: torch.randn(5, generator=generator, dtype=torch.float64) for name in names}

    def merit(t: torch.Tensor) -> torch.Tensor:
        shape = {name: getattr(lens, name) + t * directions[name] for name in names[:2]}
        melt = Melt(t * directions["shift"], torch.zeros(5, dtype=torch.float64), 0.5876)
        changed = replace(lens, **shape, melt=melt)
        rays = launch_fields(changed, in_colours(tangents_of(0, 40)), MANY)
        opened = replace(changed, semi_diameter=torch.full_like(lens.semi_diameter, torch.inf))
        rays = trace(opened, rays, changed.refractive_indices(WAVELENGTHS))
        return (rays.x.square() + rays.y.square()).mean()

    zero, one = f64([0.0]), f64([1.0])
    derivative = float(torch.autograd.functional.jacobian(merit, zero))
    assert derivative == pytest.approx(float(difference(merit, zero, 1e-5)), rel=1e-7)
    assert float(torch.func.jvp(merit, (zero,), (one,))[1]) == pytest.approx(derivative, rel=1e-11)


# ---- lost rays


def test_what_no_ray_reaches_is_lost():
    """A triplet far beyond its field: rays are reflected in its elements or miss them; finite, without gradient."""
    lens = cooke_triplet(curvature=cooke_triplet().curvature.requires_grad_())
    tangents = tangents_of(0, 20, 60, 80)
    for points in (FEW, MANY):
        rays = launch_fields(lens, in_colours(tangents), points)
        assert rays.valid[:2].all() and not rays.valid[3].any()
        image = trace(lens, rays, lens.refractive_indices(WAVELENGTHS))
        lost = ~rays.valid
        assert set(image.status[lost].tolist()) <= {RayStatus.MISSED, RayStatus.TOTAL_INTERNAL_REFLECTION}
        assert torch.equal(image.status[lost], rays.status[lost])
        assert ((image.lost_at[lost] >= 0) & (image.lost_at[lost] <= lens.stop)).all()
        for value in vars(image).values():
            assert value.isfinite().all()
        (gradient,) = torch.autograd.grad(image.x[2:].sum() + image.y.sum(), lens.curvature)
        assert gradient.isfinite().all() and gradient.any()
        outside = trace_fields(lens, in_colours(tangents[3:]), points)
        (gradient,) = torch.autograd.grad(outside.x.sum(), lens.curvature)
        assert not gradient.any()


def test_a_clear_aperture_in_front_of_the_stop_still_vignettes():
    """The same rays are launched, and those beyond the aperture end there."""
    lens, tangents = cooke_triplet(), tangents_of(0, 20)
    indices = lens.refractive_indices(WAVELENGTHS)
    clipped = replace(lens, semi_diameter=lens.semi_diameter.clone())
    clipped.semi_diameter[0] = 8.0
    rays = launch_fields(lens, in_colours(tangents), MANY)
    clipped_rays = launch_fields(clipped, in_colours(tangents), MANY)
    assert torch.equal(rays.x, clipped_rays.x) and torch.equal(rays.y, clipped_rays.y)
    behind = trace_full(lens, rays, indices)[1][0]
    image = trace(clipped, clipped_rays, indices)
    assert torch.equal(image.vignetted, torch.hypot(behind.x, behind.y) > 8.0)
    assert 0.3 < image.valid[1].double().mean() < 0.9 and (image.lost_at[image.vignetted] == 0).all()


# ---- relative illumination


def brute_force(lens: Lens, tangents: torch.Tensor, wavelength: float, half_width: float, count: int) -> torch.Tensor:
    """Illuminance of fields by counting rays: cos^4 times the area of the beam, over the image area of a field.

    Rays start on a square of the first vertex plane, whatever the pupil. Differences of chief rays give the image area.
    """
    axis = (torch.arange(count, dtype=torch.float64) + 0.5) * (2 * half_width / count) - half_width
    x, y = torch.cartesian_prod(axis, axis).T[:, None]
    indices = lens.refractive_indices((wavelength,))
    edge = torch.maximum(x.abs(), y.abs()) > half_width * (1 - 2 / count)
    light = []
    for tangent in tangents:
        view = view_at(tangent[None], wavelengths=(wavelength,))
        centre = launch_fields(lens, view, CENTRE)  # only centres the square
        n = torch.rsqrt(1 + tangent.square().sum())
        start = launch(centre.x + x, centre.y + y, torch.zeros_like(x), tangent[0] * n, tangent[1] * n, n)
        valid = trace(lens, start, indices).valid
        assert valid.any() and not (valid & edge).any()  # the square holds the whole pupil
        steps = 1e-5 * torch.cat([torch.eye(2), -torch.eye(2)]).double()
        points = chief_points(lens, view_at(tangent + steps, wavelengths=(wavelength,)))
        light.append(valid.sum() * n**4 / torch.linalg.det(points[:2] - points[2:]).abs())
    return torch.stack(light)


@pytest.mark.parametrize(
    "make, angles, half_width, clipped", [(reverse_telephoto, (0, 60), 1.0, False), (cooke_triplet, (0, 20), 7.0, True)]
)
def test_relative_illumination_is_of_the_real_pupil(make, angles, half_width, clipped):
    """Compared with 400 x 400 rays over the first surface: within 5e-3 if no aperture cuts the pupil, else 0.02.

    The image area is that of the chief ray there; these lenses are not in focus.
    """
    lens, tangents = make(), tangents_of(*angles)
    if clipped:  # smaller than the beam of the largest field
        rays = launch_fields(lens, in_colours(tangents), rim(64))
        behind = trace_full(lens, rays, lens.refractive_indices(WAVELENGTHS))[1][-2]
        height = torch.hypot(behind.x, behind.y)[-1]
        lens.semi_diameter[-2] = float(height.mean())
    light = brute_force(lens, tangents, WAVELENGTHS[1], half_width, 400)
    illumination = relative_illumination(lens, in_colours(tangents))
    torch.testing.assert_close(illumination, light / light[0], rtol=0, atol=0.02 if clipped else 5e-3)
