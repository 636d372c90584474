"""Violations of limits and their derivatives as least squares computes them, against the limits in autograd."""

from dataclasses import replace

import pytest
import torch
from designs import LIMITS, VIEW
from examples import f64, random_lens

from tasklens.design.constraints import all_margins, violation
from tasklens.design.linear_limits import LinearLimits
from tasklens.optics.rays import launch

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
    lens = replace(lens, semi_diameter=f64([0.3, *[torch.inf] * 4]))
    fields = len(VIEW.fields)
    ranges = [(-1, 1), (1, 2), (-0.2, 0.2), (-0.5, -0.3), (0.7, 0.9)]
    return lens, uniform(0.2, 0.8, 5), torch.stack([uniform(*limits, fields) for limits in ranges])


@pytest.mark.parametrize("seed", range(2))
def test_values_are_those_of_the_limits(seed):
    lens, semi_diameter, chief = example(seed)
    actual = LinearLimits(lens, STRICT, VIEW, semi_diameter, chief).values
    expected = autograd_violations(lens, semi_diameter, chief)
    assert (expected > 0).double().mean() > 0.5 and (expected == 0).any()
    torch.testing.assert_close(actual, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("seed", range(2))
def test_derivatives_are_those_of_autograd(seed):
    """Derivatives along three random changes of all parameters at once."""
    lens, semi_diameter, chief = example(seed)
    generator = torch.Generator().manual_seed(100 + seed)
    values = {"curvature": lens.curvature, "thickness": lens.thickness, "alpha": lens.alpha}
    values |= {"semi_diameter": semi_diameter, "chief": chief}
    changes = {k: torch.randn(3, *v.shape, generator=generator, dtype=torch.float64) for k, v in values.items()}

    def function(values):
        values = dict(values)
        semi_diameter, chief = values.pop("semi_diameter"), values.pop("chief")
        return autograd_violations(replace(lens, **values), semi_diameter, chief)

    actual = LinearLimits(lens, STRICT, VIEW, semi_diameter, chief).along(changes)
    for k in range(3):
        expected = torch.func.jvp(function, (values,), ({name: change[k] for name, change in changes.items()},))[1]
        torch.testing.assert_close(actual[:, k], expected, rtol=1e-10, atol=1e-11)
