"""Design for built lenses: manufacturing errors in every step and in every validation."""

import math
from dataclasses import replace

import pytest
import torch
from designs import problem, task_design, tiny_network
from examples import f64

from tasklens.design import objective
from tasklens.design.criteria import TaskLoss
from tasklens.design.image_quality import Contrast
from tasklens.design.objective import Objective
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings
from tasklens.settings.tolerance_settings import Grade

pytestmark = pytest.mark.usefixtures("few_rays")
PHONE, COMMERCIAL = map(Grade.model_validate, ("phone_moulding", "commercial_moulding"))


def objective_of(grade: Grade | None, criterion=None) -> Objective:
    return Objective(criterion or Contrast(), problem(), None, False, 1, "chief_ray", grade)


def test_built_lenses_are_drawn_anew(spot_lens):
    """The seed sets the errors of each lens; each is focused; the design stays, and is itself used without a grade."""
    first, second = objective_of(COMMERCIAL).as_built(spot_lens, 3, 2)
    (again,), (other,) = (objective_of(COMMERCIAL).as_built(spot_lens, seed) for seed in (3, 4))
    assert torch.equal(first.thickness, again.thickness) and torch.equal(first.pose.position, again.pose.position)
    for one in (second, other):
        assert not torch.equal(first.thickness[:-1], one.thickness[:-1])
        assert not torch.equal(first.pose.rotation, one.pose.rotation)
    assert spot_lens.pose is None and spot_lens.melt is None
    assert torch.isinf(first.semi_diameter[1:]).all()  # apertures stay open in a design
    assert objective_of(None).as_built(spot_lens, 3, 8) == [spot_lens]


def test_a_built_lens_carries_the_gradient_of_the_design(spot_lens):
    """The gradient of its image points by a curvature and a thickness, against differences at the same errors.

    Both sides of a difference are focused: the image plane moves with the design.
    """
    without_form = PHONE.model_copy(update={"irregularity_fringes": 0.0})  # its height depends on the aperture
    criterion, pupil = objective_of(without_form), sobol_disc(16, seed=0)

    def points(curvature: torch.Tensor, thickness: torch.Tensor) -> torch.Tensor:
        (built_lens,) = criterion.as_built(replace(spot_lens, curvature=curvature, thickness=thickness), 1)
        rays = trace_fields(built_lens, problem().view, pupil)
        return torch.where(rays.valid, rays.x, 0.0).sum()

    values = [spot_lens.curvature.clone().requires_grad_(), spot_lens.thickness.clone().requires_grad_()]
    gradients = torch.autograd.grad(points(*values), values)
    for k, surface in ((0, 2), (1, 2)):
        step = 1e-6 * f64([float(i == surface) for i in range(len(spot_lens.media))])
        more, less = ([v.detach() + s * step * (i == k) for i, v in enumerate(values)] for s in (1, -1))
        expected = float(points(*more) - points(*less)) / 2e-6
        assert float(gradients[k][surface]) == pytest.approx(expected, rel=1e-4)


def test_validation_is_of_built_lenses(spot_lens):
    """Validation is the mean of eight built lenses; a study reports others."""
    criterion = objective_of(COMMERCIAL)
    every = criterion.as_built(spot_lens, problem().seed + objective._VALIDATION_SEED, 8)
    expected = sum(objective_of(None).validation_loss(built_lens, 1.0) for built_lens in every) / 8
    assert criterion.validation_loss(spot_lens, 1.0) == pytest.approx(expected, rel=1e-12)
    assert criterion.validation_loss(spot_lens, 1.0) != objective_of(None).validation_loss(spot_lens, 1.0)


def test_built_lenses_have_the_illumination_of_the_design(spot_lens, monkeypatch):
    """It is traced by symmetry, which a decentred lens lacks; at four sets of fields, and once in a step."""
    lenses = []
    monkeypatch.setattr(objective, "relative_illumination", lambda lens, *_: lenses.append(lens) or f64([1.0] * 9))
    lit = replace(problem(), capture=CaptureSettings(sensor=SensorSettings()))
    criterion = Objective(TaskLoss(tiny_network()), lit, None, False, 72, "chief_ray", COMMERCIAL)
    assert math.isfinite(criterion.validation_loss(spot_lens, 1.0))
    (built_lens,) = criterion.as_built(spot_lens, 3)
    criterion.loss(built_lens, sobol_disc(16, seed=0), 1.0, torch.arange(2), 0, design=spot_lens)
    assert len(lenses) == 4 + 1 and all(item.pose is None for item in lenses)


@pytest.mark.slow
def test_a_design_for_built_lenses_is_another(start):
    """With equal images and rays, built lenses lead to another design; the same seed repeats it."""
    network = tiny_network()
    plain, tolerant, again = (task_design(network, start, grade=grade)[0] for grade in (None, COMMERCIAL, COMMERCIAL))
    assert not torch.equal(plain.curvature, tolerant.curvature)
    assert torch.equal(tolerant.curvature, again.curvature)
    assert tolerant.pose is None and tolerant.melt is None


def test_a_classifier_supervises_built_lenses_too(start):
    criterion, curvature = objective_of(COMMERCIAL, TaskLoss(tiny_network())), start.curvature.clone().requires_grad_()
    (built_lens,) = criterion.as_built(replace(start, curvature=curvature), 5)
    loss = criterion.loss(built_lens, sobol_disc(32, 0), 20.0, torch.arange(2), 0)
    (gradient,) = torch.autograd.grad(loss.value, curvature)
    assert torch.isfinite(loss.fields).all() and gradient.abs().sum() > 0
