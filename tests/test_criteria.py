"""Contrast of PSFs as a criterion of design."""

import math

import pytest
import torch
from examples import f64, materials
from test_design import LIMITS, LOOKS, problem

from tasklens.design import supervised
from tasklens.design.criteria import Contrast
from tasklens.design.start import flat
from tasklens.design.supervision import Supervisor
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.study.design_settings import ImageQualitySettings, RaySpaceSettings
from tasklens.study.settings import Spec

KERNEL = 21
UP, SLANTED = f64([[0.0, 1.0]]), f64([[0.6, 0.8]])


def point(column: int, row: int) -> torch.Tensor:
    """PSFs (1, 3, K, K) of a point at this distance from the centre [pixels]."""
    grid = torch.zeros(1, 3, KERNEL, KERNEL, dtype=torch.float64)
    grid[..., KERNEL // 2 + row, KERNEL // 2 + column] = 1
    return grid


def expected(along: float, across: float) -> float:
    """Loss of a point at this distance along and across the field: 1 - mean cos(2 pi f s), f of 1/8 and 1/4."""
    waves = [math.cos(2 * math.pi * f * s) for f in (1 / 8, 1 / 4) for s in (along, across)]
    return 1 - sum(waves) / 4


@pytest.mark.parametrize("column, row", [(0, 0), (0, 2), (2, 0), (3, -1)])
@pytest.mark.parametrize("direction", [UP, SLANTED])
def test_contrast_of_a_point_beside_the_centre(direction, column, row):
    """It falls with the cosine of the shift, along the field and across it; at half a period it is reversed."""
    ex, ey = direction[0].tolist()
    found = float(Contrast(direction).losses(point(column, row)))
    assert found == pytest.approx(expected(ex * column + ey * row, ex * row - ey * column), abs=1e-12)


def test_light_beside_the_window_has_no_contrast():
    assert float(Contrast(UP).losses(0.25 * point(0, 0))) == pytest.approx(0.75, abs=1e-12)
    assert float(Contrast(UP).losses(0 * point(0, 0))) == 1


def test_contrast_of_a_gaussian():
    """exp(-2 (pi f s)^2) in every direction."""
    x = torch.arange(KERNEL, dtype=torch.float64) - KERNEL // 2
    psf = torch.exp(-(x[:, None] ** 2 + x**2) / (2 * 1.5**2))
    grid = (psf / psf.sum()).expand(2, 3, -1, -1)
    contrast = [math.exp(-2 * (math.pi * f * 1.5) ** 2) for f in (1 / 8, 1 / 4)]
    found = Contrast(torch.cat([UP, SLANTED])).losses(grid)
    torch.testing.assert_close(found, f64([1 - sum(contrast) / 2] * 2), rtol=0, atol=1e-6)


def test_a_supervisor_gives_the_gradient_of_the_mean_contrast():
    """At PSFs of a lens, without a look at the images: differences of a loss that is linear in the PSFs are exact."""
    lens = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    criterion = Contrast(LOOKS.directions)
    supervisor = Supervisor(criterion, problem(), None, False, 1)
    _, grid = supervisor.trace(lens, sobol_disc(64, 0), 20.0)
    losses, gradient = supervisor.loss(torch.tensor([0]), grid, lens, seed=0)
    assert losses.shape == (9,)
    for place in ((0, 0, 5, 5), (4, 1, 2, 8), (8, 2, 0, 10)):
        more = grid.detach().clone()
        more[place] += 1
        difference = criterion.losses(more).mean() - losses.mean()
        assert float(gradient[place]) == pytest.approx(float(difference), rel=1e-9, abs=1e-12) and difference != 0


def test_contrast_alone_makes_a_lens():
    """From plates, without classifier or images: a quarter of the contrast that was lost is found again."""
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    steps = RaySpaceSettings(steps=20, pixels=(20, 10), criterion="contrast")
    settings = ImageQualitySettings(method="image_quality", batch_size=1, rays=32, restart=steps, refinement=steps)
    criteria = {"contrast": lambda part: Contrast(LOOKS.directions)}
    lens, origin, _ = supervised.design(plates, {}, criteria, problem(), settings)
    supervisor = Supervisor(criteria["contrast"](steps), problem(), None, False, 1)
    before, after = (supervisor.validation_loss(each, 10.0) for each in (plates, lens))
    assert after == pytest.approx(origin["validation_loss"], rel=1e-9) and after < 0.75 * before
