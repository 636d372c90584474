"""Criteria of a design: contrast of PSFs, correlation and Wiener error of captures, temperature of logits."""

import math
from dataclasses import replace

import pytest
import torch
from designs import LIMITS, VIEW, problem
from examples import by_descents, difference, f64, materials, random_images, rays_on_image

from tasklens.design.image_quality import Contrast, Correlation, ImageError, SpotRadius, WienerError
from tasklens.design.objective import Objective
from tasklens.design.ray_space import as_saved
from tasklens.design.start import flat
from tasklens.fields import SELECTION
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.recognition.tasks import Classification
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.specification import Spec

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


@pytest.mark.parametrize("column, row", [(0, 2), (3, -1)])
@pytest.mark.parametrize("direction", [UP, SLANTED])
def test_contrast_of_a_point_beside_the_centre(direction, column, row):
    """It falls with the cosine of the shift, along the field and across it; at half a period it is reversed."""
    ex, ey = direction[0].tolist()
    loss = float(Contrast().losses(point(column, row), direction))
    assert loss == pytest.approx(expected(ex * column + ey * row, ex * row - ey * column), abs=1e-12)


def test_light_beside_the_window_has_no_contrast():
    assert float(Contrast().losses(0.25 * point(0, 0), UP)) == pytest.approx(0.75, abs=1e-12)
    assert float(Contrast().losses(0 * point(0, 0), UP)) == 1


def test_a_supervisor_gives_the_gradient_of_the_mean_contrast():
    """At PSFs of a lens, without images: the loss is linear in the PSFs, so finite differences are exact."""
    lens = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    objective = Objective(Contrast(), problem(), None, False, 1)
    pupil = sobol_disc(64, 0)

    def loss(curvature):
        return objective.loss(replace(lens, curvature=curvature), pupil, 20.0, None, seed=0)

    curved = lens.curvature + f64([0, 0.1, -0.1, 0.05, -0.1])
    result = loss(curved.requires_grad_())
    assert result.fields.shape == (9,) and float(result.value.detach()) == pytest.approx(float(result.fields.mean()))
    (gradient,) = torch.autograd.grad(result.value, curved)
    expected = difference(lambda c: loss(c).fields.mean(), curved.detach(), 1e-6)
    torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("criterion", [Contrast(), SpotRadius(), ImageError(True)])
def test_fields_are_weighted_up_to_the_corner(start, criterion):
    """The corner weighs four times as much as the axis, in steps and on fixed images; weights have mean 1."""
    equal, weighted = (Objective(criterion, problem(), None, False, 36, corner_weight=w) for w in (1.0, 4.0))
    weights = weighted.weights(VIEW)
    assert float(weights[-1] / weights[0]) == pytest.approx(4) and float(weights.mean()) == pytest.approx(1)
    assert torch.equal(equal.weights(VIEW), torch.ones_like(weights))
    losses = [s.loss(start, sobol_disc(64, 0), 1.0, torch.arange(4), seed=0) for s in (equal, weighted)]
    weights = weighted.weights(losses[0].view)
    torch.testing.assert_close(losses[1].fields, weights * losses[0].fields, rtol=1e-5, atol=0)
    fixed = [s.fixed_losses(start, 1.0, slice(4)) for s in (equal, weighted)]
    weights = torch.stack([weighted.weights(view) for view in problem().views_of_validation])
    if not isinstance(criterion, ImageError):  # a loss for each field
        torch.testing.assert_close(fixed[1], weights.flatten() * fixed[0], rtol=1e-5, atol=0)
        return
    expected = torch.zeros_like(fixed[1])  # a loss for each image: the mean over the fields of its turn
    for image, (fields, of_turn) in enumerate(zip(SELECTION, weights, strict=True)):
        for field, weight in zip(fields, of_turn.tolist(), strict=True):
            alone = Objective(criterion, replace(problem(), fields=(field,)), None, False, 36)
            expected[image] += weight * alone.fixed_losses(start, 1.0, slice(4))[image] / len(fields)
    torch.testing.assert_close(fixed[1], expected, rtol=1e-4, atol=0)


def test_a_lost_ray_costs_a_millimetre():
    """Otherwise a design could shrink its spots by losing rays."""
    x = f64([[[0.003, -0.003, 0.5, 0.0]]])
    valid = torch.tensor([[[True, True, False, True]]])
    radius = float(SpotRadius().of_fields(rays_on_image(x, torch.zeros_like(x), valid), None, VIEW))
    assert radius == pytest.approx(math.sqrt((2 * 0.003**2 + 1) / 4))


def test_contrast_alone_makes_a_lens():
    """From plates, without classifier or images: the loss of contrast falls by a quarter."""
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    steps, contrast = DescentSettings(steps=20, pixels=(20, 10), criterion="contrast"), Contrast()
    lens, origin, _ = by_descents(plates, lambda part: contrast, problem(), steps, steps, batch_size=1, rays=32)
    objective = Objective(contrast, problem(), None, False, 1)
    saved = as_saved(lens, problem().view, LIMITS)
    before, after = (objective.validation_loss(candidate, 10.0) for candidate in (plates, saved))
    assert after == pytest.approx(origin["validation_loss"], rel=1e-9) and after < 0.75 * before


def test_correlation_does_not_see_haze():
    """Nor brightness or contrast: a scaled capture with a coloured veil has the same loss; blur has a larger one."""
    images, labels = random_images(4, 12, 3, seed=0).images.double() / 255, torch.zeros(4)
    captures = torch.nn.functional.avg_pool2d(images, 3, 1, 1)
    loss = Correlation().losses(captures, images, labels)
    veil = f64([0.1, 0.2, 0.3])[:, None, None]
    torch.testing.assert_close(Correlation().losses(0.4 * captures + veil, images, labels), loss, rtol=1e-12, atol=0)
    assert (Correlation().losses(images, images, labels).abs() < 1e-12).all() and (loss > 0.1).all()
    assert float(Correlation().losses(-images, images, labels).mean()) == pytest.approx(2)


def test_wiener_error_is_that_of_least_squares_on_shifted_captures():
    """By a filter of 7 x 7 pixels for each colour; noise-free shifts and inversions cost nothing."""
    sharp, labels = random_images(2, 24, 3, seed=0).images.double() / 255, torch.zeros(2)
    noise = torch.randn(sharp.shape, generator=torch.Generator().manual_seed(0))
    captures = torch.nn.functional.avg_pool2d(sharp, 3, 1, 1) + 0.02 * noise
    c, s = (v - v.mean((-2, -1), keepdim=True) for v in (captures, sharp))
    shifted = [c.roll((y, x), (-2, -1)).flatten(2) for y in range(-3, 4) for x in range(-3, 4)]
    columns, target = torch.stack(shifted, -1), s.flatten(2)[..., None]
    rest = target - columns @ torch.linalg.lstsq(columns, target).solution
    expected = rest.square().sum((1, 2, 3)) / s.square().sum((1, 2, 3))
    torch.testing.assert_close(WienerError().losses(captures, sharp, labels), expected, rtol=1e-3, atol=0)
    assert WienerError().losses(1 - sharp.roll((3, -2), (-2, -1)), sharp, labels).max() < 1e-3


def test_temperature_softens_confident_wrong_answers():
    """T cross_entropy(z / T): at T = 1 the cross-entropy; its gradient at a logit is softmax(z / T) - y."""
    logits, label = f64([[4.0, -2.0, 1.0]]).requires_grad_(), torch.tensor([1])
    for temperature in (1.0, 5.0):
        loss = Classification(temperature).losses(lambda captures: captures, logits, label)
        (gradient,) = torch.autograd.grad(loss.sum(), logits)
        likely = (logits.detach() / temperature).softmax(-1)
        torch.testing.assert_close(gradient, likely - f64([[0.0, 1.0, 0.0]]), rtol=1e-12, atol=0)
        assert float(loss.detach()) == pytest.approx(-temperature * math.log(float(likely[0, 1])))
