"""Descent in ray space: its steps, the weight of limits, and the way back within them."""

from pathlib import Path

import pytest
import torch
from designs import LIMITS, NO_LIMITS, VIEW, task_design, tiny_network
from examples import materials
from studies import changed, tiny_study

from tasklens.design import descents, least_squares, methods, optimizers, ray_space
from tasklens.design.constraints import (
    all_margins,
    first_order_margins,
    limit_margins,
    manufacturing_margins,
    worst_margin,
)
from tasklens.design.descent import Descent
from tasklens.design.image_quality import SpotRadius
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.design.ray_space import HARD, SOFT, LinearModel, RaySpace, as_saved, repair
from tasklens.design.start import flat
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, chief_rays, clear_semi_diameters, rms_spot_radius, trace_fields
from tasklens.optics.io import prescription
from tasklens.optics.view import view_of_spec
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.specification import Constraints, Spec
from tasklens.study.loading import parse
from tasklens.study.table_contents import lens_design


def test_a_step_moves_rays_by_its_size(start):
    """In a random direction of descent, the RMS displacement of rays is the step size, and the loss does not rise."""
    space = RaySpace(start.with_stop_scaled(0.3), VIEW, NO_LIMITS)
    gradient = torch.randn(len(space.start), generator=torch.Generator().manual_seed(0)).double()
    model = space.linearise(space.start)
    rays = space.merit.linearise(space.lens(space.start))[1](space.directions)[: space.merit.rays]
    for step_size in (0.5, 5.0):
        change = model.step(gradient, step_size, 0.1)
        assert float((rays @ change).norm()) == pytest.approx(step_size, rel=1e-2)
        assert float(gradient @ change) < 0


@pytest.mark.parametrize("weight, held", [(SOFT, 5e-3), (HARD, 5e-5)])
def test_a_gradient_holds_a_limit_violated_by_its_share_of_the_weight(weight, held):
    """A loss that falls by 5 per mm beyond a limit: its steps oscillate about a violation of 5 / w."""
    identity, gradient = torch.eye(2, dtype=torch.float64), torch.tensor([-5.0, 0.0], dtype=torch.float64)
    place, path = torch.tensor([-0.01, 0.0], dtype=torch.float64), []
    for _ in range(100):
        violated = place[:1] > 0
        model = LinearModel(1e6 * identity, identity[0] + identity[1], place[:1][violated], identity[:1][violated])
        place = place + model.step(gradient, 10.0, 0.1, weight)
        path.append(float(place[0]))
    assert max(path[50:]) == pytest.approx(held, rel=0.1)


def test_lenses_are_validated_as_they_are_saved(spot_lens):
    """A lens 0.02 beyond a limit on slopes is not the best of a descent for what its repair takes away."""
    margin = float(manufacturing_margins(spot_lens, LIMITS, clear_semi_diameters(spot_lens, VIEW))["max_slope"].min())
    limits = LIMITS.model_copy(update={"max_slope": LIMITS.max_slope - margin - 0.02})
    part = DescentSettings(steps=1, criterion="spot")
    objective = Objective(SpotRadius(), Problem(VIEW, limits, 0), None, False, 36)
    descent = Descent(spot_lens, objective, GradientDesignSettings(descents=[part], rays=32), part, seed=0)
    numbers, _ = descent.step(1)
    saved = as_saved(spot_lens, VIEW, limits)
    assert worst_margin(limit_margins(spot_lens, limits, VIEW, clear_semi_diameters(spot_lens, VIEW)))[1] < -0.01
    assert worst_margin(limit_margins(saved, limits, VIEW, saved.semi_diameter))[1] >= 0
    last = numbers["validation_loss"]  # that of the last step; the best of both is kept
    far, least = descent.least
    assert not far and least == pytest.approx(min(last, objective.validation_loss(saved, 1.0)), rel=5e-3)
    assert objective.validation_loss(spot_lens, 1.0) != pytest.approx(objective.validation_loss(saved, 1.0), rel=1e-3)


def test_a_lens_is_brought_back_within_its_limits(spot_lens):
    """Spots stay where they are within 25 um, while elements get thick enough and steep flanks flat enough."""
    margins = manufacturing_margins(spot_lens, LIMITS, clear_semi_diameters(spot_lens, VIEW))
    thick = LIMITS.min_centre_thickness + float(margins["min_centre_thickness"].min()) + 0.05
    flat_flanks = LIMITS.max_slope - float(margins["max_slope"].min()) - 0.02
    limits = LIMITS.model_copy(update={"min_centre_thickness": thick, "max_slope": flat_flanks})

    def worst(lens) -> float:
        return worst_margin(all_margins(lens, limits, VIEW, clear_semi_diameters(lens, VIEW)))[1]

    repaired, clear = repair(spot_lens, VIEW, limits)
    assert worst(spot_lens) < -0.019 and worst(repaired) > 0
    merit = RaySpace(spot_lens, VIEW, NO_LIMITS).merit
    before, after = (merit.residuals(item)[: merit.rays] for item in (spot_lens, repaired))
    assert float((after - before).norm()) < 25
    assert worst_margin(manufacturing_margins(repaired, limits, clear))[1] > 0
    again, _ = repair(repaired, VIEW, limits)
    assert torch.equal(again.curvature, repaired.curvature)


def test_a_lens_within_its_limits_stays_as_it_is(spot_lens):
    """Also a lens closer to its limits than the margin that descents aim at."""
    lens, clear = repair(spot_lens, VIEW, LIMITS)
    least = worst_margin(manufacturing_margins(lens, LIMITS, clear))[1]
    margin = float(manufacturing_margins(lens, LIMITS, clear)["min_centre_thickness"].min())
    thinnest = LIMITS.min_centre_thickness + margin - 1e-6
    repaired, _ = repair(lens, VIEW, LIMITS.model_copy(update={"min_centre_thickness": thinnest}))
    assert least > 0 and torch.equal(repaired.thickness, lens.thickness) and torch.equal(repaired.alpha, lens.alpha)


@pytest.mark.parametrize("limit", ["min_edge_thickness", "min_air_gap"])
def test_a_sharp_lens_stays_sharp_while_it_is_repaired(limit):
    """Spots of 1.5 um grow by less than 0.1 um for 2 um of an edge or a gap, far less than the longest step."""
    lens = prescription.read(Path(__file__).parent / "data" / "sharp_quadruplet.yaml")[0].lens.with_open_apertures()
    view, limits = view_of_spec(Spec()), Constraints()
    margin = float(manufacturing_margins(lens, limits, clear_semi_diameters(lens, view))[limit].min())
    limits = limits.model_copy(update={limit: getattr(limits, limit) + margin + 0.002})
    repaired, clear = repair(lens, view, limits)
    assert worst_margin(manufacturing_margins(repaired, limits, clear))[1] >= 0
    rays = [trace_fields(item, view, sobol_disc(256, 0)) for item in (lens, repaired)]
    before, after = (1e3 * rms_spot_radius(item, centroid(item)).mean() for item in rays)
    assert before < 1.6 and after < before + 0.1


def test_distortion_is_repaired_between_the_heights_of_the_merit_function():
    """A triplet with 2.9 % at all heights of the merit function has 3.02 at a field in between; its spots stay."""
    file = Path(__file__).parent / "data" / "distorted_between_heights.yaml"
    lens = prescription.read(file)[0].lens.with_open_apertures()
    view, limits = view_of_spec(Spec()), Constraints()

    def margin(lens) -> float:
        return float(first_order_margins(lens, limits, view, chief_rays(lens, view))["distortion"].min())

    repaired, _ = repair(lens, view, limits)
    assert margin(lens) < -1e-4 and margin(repaired) > 0
    rays = [trace_fields(item, view, sobol_disc(256, 0)) for item in (lens, repaired)]
    before, after = (1e3 * rms_spot_radius(item, centroid(item)).mean() for item in rays)
    assert abs(float(after - before)) < 0.1


@pytest.mark.parametrize("name", ["imaging1", "imaging2"])
def test_every_finished_design_is_within_its_limits(spot_lens, monkeypatch, name):
    """Every method repairs small violations at the end, here an element 0.03 mm too thin."""
    study = parse(changed(tiny_study(), "elements", {"doublet": ["COC", "OKP4"]}))
    settings = lens_design(study, f"doublet-{name}", 0)
    margins = manufacturing_margins(spot_lens, LIMITS, clear_semi_diameters(spot_lens, VIEW))
    thinnest = LIMITS.min_centre_thickness + float(margins["min_centre_thickness"].min()) + 0.03
    settings = settings.model_copy(update={"constraints": LIMITS.model_copy(update={"min_centre_thickness": thinnest})})
    monkeypatch.setattr(descents, "design", lambda *rest: (spot_lens, {}, [], None))
    monkeypatch.setattr(least_squares, "design", lambda *rest: (spot_lens, []))
    _, notes, *_ = methods.design(settings, None, None, {}, {})
    assert notes["worst_margin"]["value"] > 0
    _, unrepaired = methods.with_notes(spot_lens, clear_semi_diameters(spot_lens, VIEW), settings, {})
    assert unrepaired["worst_margin"]["value"] < -0.02


def test_a_step_far_outside_the_limits_is_taken_back(monkeypatch, few_rays):
    """Steps are halved: long steps then violate limits only a little, instead of destroying the lens."""
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    far = DescentSettings(steps=6, pixels=(20, 20), step_size=5.0)

    def longest() -> float:
        _, history = task_design(tiny_network(), plates, parts=(far,))
        return max(row["violation"] for row in history[1:])

    with_halving = longest()
    monkeypatch.setattr(optimizers, "_HALVINGS", 0)
    assert longest() > 2 * with_halving  # three to ten; it depends on the processor


def test_a_repair_that_cannot_succeed_ends_at_the_smallest_violation(spot_lens, monkeypatch):
    """Two limits that contradict each other: the last step may be worse than an earlier one."""
    impossible = LIMITS.model_copy(update={"max_track": 2.0, "min_back_focus": 2.5})
    norms, linearise = [], RaySpace.linearise

    def recorded(self, vector):
        model = linearise(self, vector)
        norms.append(model.violation_norm)
        return model

    monkeypatch.setattr(RaySpace, "linearise", recorded)
    lens = ray_space._repair(spot_lens, VIEW, impossible, None)
    least = min(norms)
    space = RaySpace(lens, VIEW, impossible)
    assert space.linearise(space.start).violation_norm == pytest.approx(least, rel=1e-6) and least > 0.1
