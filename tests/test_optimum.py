"""The test of a local optimum: on losses with a known optimum, and on a lens that is not an optimum."""

from dataclasses import dataclass, replace

import pytest
import torch
from designs import LIMITS, VIEW, problem
from examples import by_descents, materials

from tasklens.design import criteria
from tasklens.design.image_quality import Contrast, ImageError, SpotRadius
from tasklens.design.objective import Objective
from tasklens.design.optimum import local_optimum
from tasklens.design.ray_space import RaySpace, as_saved
from tasklens.design.start import flat
from tasklens.fields import PAPER
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.specification import Spec
from tasklens.settings.tolerance_settings import Grade
from tasklens.show.optimality import Optimum

PART = DescentSettings(steps=1, pixels=(5, 5))


@dataclass(frozen=True)
class Bowl(SpotRadius):
    """The mean squared distance of rays from those of another lens [(10 um)^2]: quadratic, zero at that lens."""

    target: object

    def of_fields(self, rays, grid, view):
        goal = trace_fields(self.target, VIEW, sobol_disc(rays.x.shape[-1], seed=0))
        return 1e4 * ((rays.x - goal.x) ** 2 + (rays.y - goal.y) ** 2).mean((1, 2))


@pytest.fixture(scope="module")
def feasible(spot_lens):
    """A lens inside all limits, with its clear apertures."""
    return as_saved(spot_lens, VIEW, LIMITS)


def examine(lens, target) -> Optimum:
    objective = Objective(Bowl(target), replace(problem(), fields=PAPER), None, False, 36)
    return Optimum(**local_optimum(lens, objective, PART))


def test_the_bottom_of_a_bowl_is_an_optimum(feasible):
    result = examine(feasible, feasible)
    assert result.reached and result.gain <= 1e-9
    assert (result.error, result.images) == (0, 0)  # a loss of rays has no images and no sampling error


def test_a_lens_on_the_slope_of_a_bowl_is_none(feasible):
    """Rays 4 um from their target: of 0.5, 2 and 8 um, a step of 2 along the gradient wins most, (4^2 - 2^2) / 100."""
    space = RaySpace(feasible, VIEW, LIMITS)
    gradient = torch.randn(len(space.start), generator=torch.Generator().manual_seed(3)).double()
    model = space.linearise(space.start)
    target = space.lens(space.start + model.step(model.metric @ (model.scale * gradient), 4.0, 0.1))
    result = examine(feasible, target)
    assert not result.reached and result.along == "gradient" and result.step_um == 2.0
    assert 0.03 < result.gain < 0.2


def test_a_descent_that_was_cut_short_has_not_converged(monkeypatch):
    """By the spot, a lens after few steps from flat plates is far from its optimum; after many more steps it is not."""
    monkeypatch.setattr(criteria, "VALIDATION_RAYS", 64)
    monkeypatch.setattr("tasklens.design.optimum._DIRECTIONS", 0)
    posed = replace(problem(), seed=0)
    objective, gains = Objective(SpotRadius(), posed, None, False, 36), []
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    for steps in (5, 250):
        part = DescentSettings(steps=steps, criterion="spot", pixels=(10, 1), duration=0.7, final=0.02)
        lens, _, _ = by_descents(plates, lambda part: SpotRadius(), posed, part, rays=64)
        finished = as_saved(lens, VIEW, LIMITS)
        gains.append(Optimum(**local_optimum(finished, objective, part)).gain)
    assert gains[0] > 0.002 and gains[1] < 0.02 * gains[0]  # [mm]


def test_a_design_by_contrast_needs_no_images(feasible, few_rays, monkeypatch):
    """Its test of the optimum, too; built lenses of a toleranced design differ in it."""
    without = replace(problem(), dataset=None, capture=None)
    objective = Objective(Contrast(), without, None, False, 36)
    result = local_optimum(feasible, objective, PART)
    with_images = local_optimum(feasible, replace(objective, problem=problem()), PART)
    assert result["gain"] == pytest.approx(with_images["gain"], rel=1e-9) and result["images"] == 0
    monkeypatch.setattr("tasklens.design.objective._VALIDATION_BUILT", 2)
    monkeypatch.setattr("tasklens.design.optimum._LENSES", 2)
    built = replace(objective, grade=Grade.model_validate("precision_moulding"))
    assert local_optimum(feasible, built, PART)["gain"] != result["gain"]


def test_steps_are_compared_on_other_images_than_those_of_the_gradient(feasible, monkeypatch):
    """One half of the selection images gives the gradient, the other half judges every step."""
    calls, images = [], Objective.images

    def recorded(self, indices, augment):
        calls.append(set(indices.tolist()))
        return images(self, indices, augment)

    monkeypatch.setattr(Objective, "images", recorded)
    local_optimum(feasible, Objective(ImageError(False), problem(), None, False, 36), PART)
    of_gradient, *turns = calls
    of_steps = [set().union(*turns[k : k + 4]) for k in range(0, len(turns), 4)]  # images take four sets of fields
    assert len(of_steps) == 1 + 3 + 4 and all(judging == of_steps[0] for judging in of_steps)
    assert of_gradient.isdisjoint(of_steps[0]) and of_gradient | of_steps[0] == set(range(12))
