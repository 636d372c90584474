"""Constraints of every design: margins, penalties, violations; and their derivatives in least squares."""

import math
from dataclasses import replace

import pytest
import torch
from designs import LIMITS, SPEC, VIEW
from examples import f64, materials, random_lens

from tasklens.design.constraints import (
    all_margins,
    first_order_margins,
    manufacturing_margins,
    penalty,
    smallest_margins,
    violation,
    worst_margin,
)
from tasklens.design.linear_limits import LinearLimits
from tasklens.design.start import flat
from tasklens.optics.rays import launch


def sphere_sag(radius: float, r: float) -> float:
    return radius - math.sqrt(radius**2 - r**2)


SEMI, R = 0.8, 2.0
FLAT = flat(materials("COC"), SPEC, LIMITS)


def plates(thickness, curvature=(0.0, 0.0, 0.0)):
    return replace(FLAT, thickness=f64(thickness), curvature=f64(curvature))


BROKEN = {
    "min_centre_thickness": (plates([0.1, 0.22, 2.0]), 0.22 - 0.25),
    "max_centre_thickness": (plates([0.1, 1.62, 2.0]), 1.5 - 1.62),
    "min_edge_thickness": (plates([0.1, 0.4, 2.0], [0, 1 / R, -1 / R]), 0.4 - 2 * sphere_sag(R, SEMI) - 0.2),
    "min_air_gap": (plates([0.1, 0.9, 2.0], [0, -1 / R, 0]), 0.1 - sphere_sag(R, SEMI) - 0.05),
    "min_back_focus": (plates([0.1, 0.9, 0.8], [0, 0, 1 / R]), 0.8 - sphere_sag(R, SEMI) - 0.7),
    "max_track": (plates([0.1, 1.0, 3.5]), 4.4 - 4.6),
    "max_slope": (plates([0.3, 1.0, 2.0], [0, 0, 1 / 1.1]), 0.57 - SEMI / math.sqrt(1.1**2 - SEMI**2)),
}


@pytest.mark.parametrize("limit", BROKEN)
def test_a_broken_limit_reports_by_how_much(limit):
    """Spheres and plates whose violation is known in closed form; the other limits hold."""
    lens, expected = BROKEN[limit]
    assert expected < 0
    margins = manufacturing_margins(lens, LIMITS, torch.full((3,), SEMI, dtype=torch.float64))
    assert set(margins) == set(BROKEN)
    assert float(margins[limit].min()) == pytest.approx(expected, abs=1e-12)
    others = {name: value for name, value in margins.items() if name != limit}
    assert worst_margin(others)[1] > 0
    assert worst_margin(margins) == (limit, pytest.approx(expected, abs=1e-12))


@pytest.mark.parametrize("semi", [(SEMI, SEMI, 0.6), (SEMI, 0.6, SEMI)])
def test_edges_end_in_flanges(semi):
    """An element extends to the larger of its two beams; beyond its own beam a surface is a flat flange."""
    lens, _ = BROKEN["min_edge_thickness"]
    margins = manufacturing_margins(lens, LIMITS, f64(semi))
    expected = 0.4 - sphere_sag(R, SEMI) - sphere_sag(R, 0.6) - 0.2
    assert float(margins["min_edge_thickness"].min()) == pytest.approx(expected, abs=1e-12)


def test_elements_that_overlap_only_between_axis_and_rim_are_found():
    """Air gaps are checked at several heights: aspheres may touch between vertex and edge."""
    alpha = torch.zeros(5, 5, dtype=torch.float64)
    alpha[3, 0], alpha[3, 1] = -0.64, 1.0  # sag r^2 (r^2 - 0.64): zero at the vertex and at r = 0.8, -0.1 between
    base = flat(materials("COC", "OKP4"), SPEC, LIMITS)
    lens = replace(base, alpha=alpha, thickness=f64([0.1, 0.8, 0.1, 0.8, 1.5]))
    margins = manufacturing_margins(lens, LIMITS, torch.full((5,), 0.8, dtype=torch.float64))
    assert float(margins["min_air_gap"].min()) == pytest.approx(0.1 - 0.32**2 - 0.05, abs=2e-3)


def test_focal_length_and_distortion_margins(start):
    """A lens 5 % too long, and chief rays 6 % too far out, exceed their limits of 2 and 3 % by the difference.

    If it is limited, the chief-ray angle is the angle to the axis, in any meridian; the axis field has no limit.
    """
    longer = replace(VIEW, efl=VIEW.efl / 1.05)
    x, y = 1.06 * longer.fields.T[..., None, None]
    zero = torch.zeros_like(x)
    chief = launch(x, y, zero, zero + 0.3, zero + 0.4, zero + math.sqrt(0.75))
    margins = first_order_margins(start, LIMITS, longer, chief)
    assert "chief_ray_angle" not in margins
    limited = LIMITS.model_copy(update={"max_chief_ray_angle_deg": 33.0})
    angle = first_order_margins(start, limited, longer, chief)["chief_ray_angle"]
    torch.testing.assert_close(angle, torch.full((8,), math.radians(33 - 30), dtype=torch.float64))
    assert smallest_margins({"chief_ray_angle": angle, "distortion": angle}) == pytest.approx(
        {"chief_ray_angle": 3.0, "distortion": math.radians(3)}, abs=1e-9
    )
    assert float(margins["efl_tolerance"]) == pytest.approx(0.02 - (1 - 1 / 1.05), abs=1e-9)
    torch.testing.assert_close(margins["distortion"], torch.full((8,), 0.03 - 0.06, dtype=torch.float64))


def test_penalty_is_zero_inside_and_pushes_outward():
    """Steepest descent of the penalty thickens a plate that is too thin and flattens a surface that is too steep."""
    limits = LIMITS.model_copy(update={"efl_tolerance": 9.0, "distortion": 9.0})  # plates have no focal length
    good = plates([0.2, 0.9, 2.0])
    assert float(penalty(good, limits, VIEW)) == 0

    def slope(lens, name):
        leaf = getattr(lens, name).clone().requires_grad_()
        return torch.autograd.grad(penalty(replace(lens, **{name: leaf}), limits, VIEW), leaf)[0]

    assert slope(plates([0.2, 0.1, 2.0]), "thickness")[1] < 0
    assert slope(plates([0.2, 1.0, 3.5]), "thickness").min() > 0  # the track limit shrinks every space
    for sign in (1, -1):
        assert sign * slope(plates([0.6, 1.0, 2.0], [0, sign / 1.1, 0]), "curvature")[1] > 0
    assert float(penalty(good, LIMITS, VIEW)) > 0.9  # zero power instead of the full power


def test_shortfall_begins_before_the_limit():
    """Designs aim a buffer inside: at the limit itself the violation is already positive, far inside it is zero."""
    violations = violation({"min_air_gap": f64([0.0, 1.0, -0.5])})
    assert violations[0] > 0 and violations[1] == 0 and float(violations[2] - violations[0]) == pytest.approx(0.5)
    for name in ("efl_tolerance", "distortion", "chief_ray_angle"):  # fractions and radians
        assert float(violation({name: f64([0.0])})) == pytest.approx(0.1 * float(violations[0]))


STRICT = LIMITS.model_copy(
    update={
        **{"efl_tolerance": 1e-4, "distortion": 1e-4, "max_slope": 0.05, "max_track": 0.5, "max_centre_thickness": 0.4},
        **{"min_centre_thickness": 0.5, "min_edge_thickness": 2.0, "min_back_focus": 9.0, "min_air_gap": 1.0},
        "max_chief_ray_angle_deg": 5.0,
    }
)


def autograd_violations(lens, semi_diameter, chief) -> torch.Tensor:
    x, y, l, m, n = chief[..., None, None]
    rays = launch(x, y, torch.zeros_like(x), l, m, n)
    return violation(all_margins(lens, STRICT, VIEW, semi_diameter, rays))


def example(seed: int) -> tuple:
    """A lens with aspheres, illuminated radii (one below the stop's), and chief rays; every limit is violated."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    lens = random_lens(seed)
    media = (*lens.media[: 5 - 2 * seed], *lens.media[:1] * 2 * seed)  # the second ends in two surfaces in air
    lens = replace(lens, semi_diameter=f64([0.3, *[torch.inf] * 4]), media=media)
    fields = len(VIEW.fields)
    ranges = [(-1, 1), (1, 2), (-0.2, 0.2), (-0.5, -0.3), (0.7, 0.9)]
    return lens, uniform(0.2, 0.8, 5), torch.stack([uniform(*limits, fields) for limits in ranges])


@pytest.mark.parametrize("seed", range(2))
def test_values_and_derivatives_are_those_of_the_limits(seed):
    """Derivatives along two random changes of all parameters at once."""
    lens, semi_diameter, chief = example(seed)
    linear = LinearLimits(lens, STRICT, VIEW, semi_diameter, chief)
    expected = autograd_violations(lens, semi_diameter, chief)
    assert (expected > 0).double().mean() > 0.5 and (expected == 0).any()
    torch.testing.assert_close(linear.values, expected, rtol=1e-12, atol=1e-14)
    generator = torch.Generator().manual_seed(100 + seed)
    values = {"curvature": lens.curvature, "thickness": lens.thickness, "alpha": lens.alpha}
    values |= {"semi_diameter": semi_diameter, "chief": chief}
    changes = {k: torch.randn(2, *v.shape, generator=generator, dtype=torch.float64) for k, v in values.items()}

    def function(values):
        values = dict(values)
        semi_diameter, chief = values.pop("semi_diameter"), values.pop("chief")
        return autograd_violations(replace(lens, **values), semi_diameter, chief)

    actual = linear.along(changes)
    for k in range(2):
        expected = torch.func.jvp(function, (values,), ({name: change[k] for name, change in changes.items()},))[1]
        torch.testing.assert_close(actual[:, k], expected, rtol=1e-10, atol=1e-11)
