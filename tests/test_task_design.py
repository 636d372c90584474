"""Task-driven design: its restarts, its candidates and their finish, and descents with a network trained jointly."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from designs import LIMITS, NO_LIMITS, VIEW, image_error, problem, task_design, tiny_network
from examples import by_descents, materials, random_images
from torch.nn import BatchNorm2d
from torch.nn.functional import interpolate

from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.design.constraints import manufacturing_margins
from tasklens.design.criteria import JointTaskLoss
from tasklens.design.descent import Descent
from tasklens.design.image_quality import ImageError, SpotRadius
from tasklens.design.objective import SELECTION_IMAGES, VALIDATION_IMAGES, Objective
from tasklens.design.ray_space import repair
from tasklens.design.start import flat
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, clear_semi_diameters, evaluation_psf, rms_spot_radius, trace_fields
from tasklens.optics.psf import psf
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.specification import Spec

pytestmark = pytest.mark.usefixtures("few_rays")


def test_frozen_network_stays_frozen(start):
    """Task-driven design moves the lens and nothing of the network: no weight, no batch statistic, no switch."""
    network = tiny_network().train()
    before = copy.deepcopy(network.state_dict())
    lens, history = task_design(network, start)
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    assert network.training and all(p.requires_grad and p.grad is None for p in network.parameters())
    assert not torch.equal(lens.curvature, start.curvature) and not torch.equal(lens.thickness, start.thickness)
    assert torch.equal(lens.semi_diameter, start.semi_diameter)
    assert len(history) == 2 * 3 + 2 and all(math.isfinite(row["loss"]) for row in history)


@pytest.mark.parametrize("pixels, step_size, validations", [((5, 5), 20.0, 24), ((20, 5), 4.0, 12)])
def test_a_descent_returns_its_best_lens(start, pixels, step_size, validations):
    """Steps far too long destroy the lens; the result is the lens of the least loss on the fixed images.

    After three validations without a better lens, the descent returns to the best lens and halves the step size.
    """
    options = {"pixels": pixels, "duration": 0.5, "step_size": step_size, "final": 1.0}
    far = DescentSettings(steps=24, criterion="log_image_error", **options)
    still = far.model_copy(update={"steps": 2, "step_size": 1e-9, "pixels": (5, 5)})
    _, _, history = by_descents(start, image_error, problem(NO_LIMITS), far, still, augment=True)
    rows = [row for row in history if "validation_loss" in row]
    validated, steps = [row["validation_loss"] for row in rows], [row["step_size_um"] for row in rows]
    restart, first_of_refinement = validated[:-2], validated[-2]
    assert len(restart) == validations
    assert any(later > min(restart[:k]) for k, later in enumerate(restart) if k)
    assert first_of_refinement == pytest.approx(min(restart), rel=1e-12)
    best, failures = math.inf, 0
    for k, loss in enumerate(restart[:-1]):  # the last is after the last step
        best, failures = (loss, 0) if loss <= best else (best, failures + 1)
        halved = failures == 3
        failures = 0 if halved else failures
        assert k == 0 or steps[k] == pytest.approx(steps[k - 1] / (2 if halved else 1))
    assert steps[-3] < steps[0]


def test_several_restarts_are_refined(start, monkeypatch):
    """The two of three restarts with the least loss are refined by a negligible step; the better result is the lens."""
    lenses, losses = [], iter([2.0, 1.0, 3.0, 0.5, 0.7, 0.1])  # restarts, refinements, finish

    def validation_loss(self, lens, pixels):
        lenses.append(lens)
        return next(losses)

    def distance(one, other) -> float:
        return float((one.curvature - other.curvature).abs().max())

    monkeypatch.setattr(Objective, "validation_loss", validation_loss)
    restarts = DescentSettings(steps=1, pixels=(20, 19), duration=1.0, lenses=3)
    parts = [restarts.model_copy(update={"lenses": count, "step_size": 1e-9}) for count in (2, 1)]
    lens, _, history = by_descents(start, image_error, problem(NO_LIMITS), restarts, *parts)
    of_restarts = [distance(one, other) for one, other in ((lenses[0], lenses[1]), (lenses[1], lenses[2]))]
    of_refinements = [distance(lenses[1], lenses[3]), distance(lenses[0], lenses[4]), distance(lenses[1], lens)]
    assert max(of_refinements) < 0.01 * min(of_restarts)
    rows = [(row["phase"], row["validation_loss"]) for row in history]
    assert rows == [
        ("descent 1, lens 1 of 3", 2.0),
        ("descent 1, lens 2 of 3", 1.0),
        ("descent 1, lens 3 of 3", 3.0),
        ("descent 2, lens 1 of 2", 0.5),
        ("descent 2, lens 2 of 2", 0.7),
        ("descent 3", 0.1),
    ]


def test_the_best_candidate_is_the_start(spot_lens):
    """Plates lose to a lens in focus; the losses stand in history and origin."""
    still = DescentSettings(steps=2, pixels=(5, 5), step_size=1e-9, criterion="log_image_error", centre="chief_ray")
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    candidates = {"plates": plates, "sharp": spot_lens}
    lens, origin, history = by_descents(plates, image_error, problem(NO_LIMITS), still, candidates=candidates)
    losses = {row["phase"]: row["validation_loss"] for row in history if row["phase"].startswith("candidate")}
    assert origin["start"] == "sharp" and losses["candidate sharp"] == min(losses.values())
    assert origin["candidate_losses"] == {name.removeprefix("candidate "): loss for name, loss in losses.items()}
    assert origin["validation_loss"] == pytest.approx(losses["candidate sharp"], rel=1e-6)
    torch.testing.assert_close(lens.curvature, spot_lens.curvature, rtol=0, atol=1e-6)


@pytest.mark.parametrize("finished, kept", [(1.5, "sharp"), (0.5, "finished")])
def test_a_finish_that_is_worse_on_other_images_is_not_kept(start, monkeypatch, finished, kept):
    """Losses from a list: plates 2, sharp 1, then the finished lens; the lens file has the loss of its own lens."""
    losses = iter([2.0, 1.0, finished])
    monkeypatch.setattr(Objective, "selection_loss", lambda self, lens, pixels: next(losses))
    finish = DescentSettings(steps=2, pixels=(5, 5), step_size=1.0, criterion="log_image_error")
    sharp, plates = start, replace(start, curvature=0 * start.curvature)
    candidates = {"plates": plates, "sharp": sharp}
    lens, origin, history = by_descents(plates, image_error, problem(NO_LIMITS), finish, candidates=candidates)
    assert origin["validation_loss"] == min(1.0, finished) and origin["start"] == "sharp"
    assert torch.equal(lens.curvature, sharp.curvature) is (kept == "sharp")
    assert origin["finished"] is (kept == "finished")
    assert history[-1] == {"phase": "finished", "validation_loss": finished}


class Failing(ImageError):
    """An image error that is not finite from some step on."""

    def __init__(self, steps):
        super().__init__(True)
        object.__setattr__(self, "left", [steps])

    def losses(self, captures, images, labels):
        self.left[0] -= torch.is_grad_enabled()
        return super().losses(captures, images, labels) * (torch.nan if self.left[0] < 0 else 1)


@pytest.mark.parametrize("fails_at, in_origin", [(1, False), (3, True), (5, False)])
def test_a_lens_file_names_a_divergence_that_led_to_it(start, monkeypatch, fails_at, in_origin):
    """It reports a divergence of its own descents, not of a rejected restart or a rejected finish."""
    parts = [DescentSettings(steps=1, pixels=(20, 20), lenses=lenses) for lenses in (2, 1)]
    if fails_at == 5:  # of a finish that is worse than its start
        losses = iter([1.0, 2.0])
        monkeypatch.setattr(Objective, "selection_loss", lambda self, lens, pixels: next(losses))
        failing = Failing(1)
        parts = [DescentSettings(steps=2, pixels=(20, 20))]
        _, origin, _ = by_descents(start, lambda p: failing, problem(), *parts, candidates={"start": start})
    else:
        criteria = iter([Failing(0 if fails_at == 3 else 99), Failing(0), Failing(99)])  # restarts, refinement
        _, origin, _ = by_descents(start, lambda p: next(criteria), problem(), *parts)
    assert ("diverged" in origin) is in_origin


def test_a_finish_is_judged_as_its_file_will_have_it(start, monkeypatch):
    """Selection uses the repaired lens with clear apertures, which can cost more than the descent has gained."""
    evaluated_lenses = []

    def selection_loss(objective, lens, pixels):
        evaluated_lenses.append(lens)
        return 1.0

    monkeypatch.setattr(Objective, "selection_loss", selection_loss)
    finish = DescentSettings(steps=1, pixels=(5, 5), step_size=0.1, criterion="log_image_error")
    margins = manufacturing_margins(start, LIMITS, clear_semi_diameters(start, VIEW))
    least = LIMITS.min_centre_thickness + float(margins["min_centre_thickness"].min()) + 0.05  # violated by 0.05 mm
    limits = LIMITS.model_copy(update={"min_centre_thickness": least})
    lens, _, _ = by_descents(start, image_error, problem(limits), finish, candidates={"start": start})
    repaired, _ = repair(lens, VIEW, limits)
    assert not torch.equal(repaired.thickness, lens.thickness)
    assert torch.equal(evaluated_lenses[-1].thickness, repaired.thickness)
    assert lens.semi_diameter.isinf().any() and not evaluated_lenses[-1].semi_diameter.isinf().any()


def test_lenses_are_chosen_by_images_that_lead_no_descent(start, monkeypatch):
    """Validation uses 48 of 300 images, selection 192 others, the same ones each time; of 1000 steps use the rest."""
    batches, images = [], Objective.images
    objective = Objective(ImageError(True), replace(problem(), dataset=random_images(300, 16, 3, 0)), None, False, 36)

    def recorded(self, indices, augment):
        batches.append(indices)
        return images(self, indices, augment)

    monkeypatch.setattr(Objective, "images", recorded)
    for loss in (objective.validation_loss, objective.selection_loss) * 2:
        loss(start, 1.0)
    assert [len(indices) for indices in batches] == [*4 * [12], *4 * [48]] * 2  # in four turns
    first, second = torch.cat(batches[:8]), torch.cat(batches[8:])
    assert torch.equal(first, second) and len(first.unique()) == 240
    assert objective.batch_images().tolist() == list(range(300))  # too few to leave some out
    many = replace(objective, problem=replace(problem(), dataset=random_images(1000, 8, 3, 0)))
    fixed = [{*many.fixed_images(part).tolist()} for part in (VALIDATION_IMAGES, SELECTION_IMAGES)]
    assert {*many.batch_images().tolist()} == {*range(1000)} - fixed[0] - fixed[1]
    part = DescentSettings(steps=6)
    descent = Descent(start, many, GradientDesignSettings(descents=[part], batch_size=30), part, seed=0)
    seen = torch.cat([descent.images[descent.order.next()] for _ in range(40)])
    assert not {*seen.tolist()} & (fixed[0] | fixed[1])


def test_the_noise_of_fixed_images_is_the_same_in_any_micro_batches(start):
    """Successive images have different noise, also images of an odd size, which torch draws in blocks."""
    posed = replace(problem(), capture=CaptureSettings(sensor=SensorSettings(gain=16)))
    objectives = [Objective(ImageError(False), posed, 15, False, at_once) for at_once in (9, 45)]
    losses = [objective.validation_loss(start, 1.0) for objective in objectives]
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


def test_vignetted_light_is_neither_blur_nor_haze(start):
    """Of a lens that vignettes, designs see the PSFs and spots that are measured: those of the light that passes."""
    view, pupil = problem().view, sobol_disc(256, seed=0)
    radii = 0.9 * clear_semi_diameters(start, view)
    rim = torch.arange(len(radii)) == len(radii) - 1
    lens = replace(start, semi_diameter=torch.where(rim, radii, start.semi_diameter))
    rays, grid = Objective(ImageError(True), problem(), None, False, 12, "chief_ray").trace(lens, view, pupil, 1.0)
    assert 0 < rays.vignetted.double().mean() < 0.5
    torch.testing.assert_close(grid, evaluation_psf(lens, view, len(pupil)))
    torch.testing.assert_close(SpotRadius().of_fields(rays, None, view), rms_spot_radius(rays, centroid(rays)))


def test_distortion_costs_nothing_about_the_chief_ray(start):
    """Behind a lens in focus for 3 % more distance, light is where its chief ray is, not where a pinhole's is."""
    view = problem().view
    lens = replace(start, curvature=0 * start.curvature)
    stretched = replace(lens, thickness=1.03 * lens.thickness)
    pupil = 0.01 * sobol_disc(16, 0)  # a narrow stop, so that plates make points
    energies = {}
    for centre in ("pinhole", "chief_ray"):
        objective = Objective(ImageError(True), problem(), None, False, 12, centre)
        energies[centre] = objective.trace(stretched, view, pupil, 1.0)[1].sum((-2, -1)).mean(-1)
    outer = view.radii > 20e-3 * view.kernel_size * view.pixel_pitch_um
    assert outer.any() and (energies["chief_ray"] > 0.999).all() and (energies["pinhole"][outer] < 0.001).all()


def test_the_image_error_alone_makes_a_lens():
    """Without a classifier, from plates: captures of soft images come nearer to the sharp ones, by 3 dB at least."""
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    noise = torch.rand(12, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    soft = (255 * interpolate(noise, 16, mode="bilinear")).to(torch.uint8)
    images = replace(problem().dataset, images=soft)

    def quality(lens):
        grid = psf(trace_fields(lens, VIEW, sobol_disc(64, 9)), VIEW.fields, 10 * VIEW.pixel_pitch_um, 11)
        sharp = images.batch(torch.arange(12))[0]
        return float(psnr(PsfCamera(grid.float()).all_fields(sharp), sharp).mean())

    steps = DescentSettings(steps=20, pixels=(20, 10), criterion="log_image_error")
    posed = replace(problem(), dataset=images)
    lens, _, _ = by_descents(plates, image_error, posed, steps, steps, batch_size=6, rays=32)
    assert quality(lens) > quality(plates) + 3


def test_a_joint_descent_trains_a_classifier_of_its_own(start):
    """Two restarts and a refinement begin with the trained classifier, move copies of it, and leave the original."""
    network, criteria = tiny_network().train(), []
    before = copy.deepcopy(network.state_dict())

    def joint(part):
        criteria.append(JointTaskLoss(copy.deepcopy(network), 1e-2, part.steps, part.final))
        return criteria[-1]

    descent = DescentSettings(steps=3, pixels=(5, 5), network_learning_rate=1e-2)
    restarts = descent.model_copy(update={"lenses": 2})
    by_descents(start, joint, problem(NO_LIMITS), restarts, descent, micro_batch=4)
    assert len(criteria) == 3 and all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    for criterion in criteria:
        trained = criterion.network
        assert trained.training and criterion.schedule.last_epoch == descent.steps
        assert all(not torch.equal(v, before[k]) for k, v in trained.state_dict().items())
        # Validations do not count: batch norms track only the batches of the steps.
        batches = [m.num_batches_tracked for m in trained.modules() if isinstance(m, BatchNorm2d)]
        assert batches and all(int(count) == descent.steps for count in batches)


def test_a_network_that_changes_halves_no_step(start):
    """An unchanged lens is no worse than the best, even if a network trained too fast classifies it ever worse."""
    network = tiny_network().train()
    finish = DescentSettings(steps=16, pixels=(5, 5), step_size=1e-9, final=1.0, network_learning_rate=1.0)

    def joint(part):
        return JointTaskLoss(copy.deepcopy(network), 1.0, part.steps, 1.0)

    _, _, rows = by_descents(start, joint, problem(NO_LIMITS), finish)
    losses = [row["validation_loss"] for row in rows if "validation_loss" in row]
    assert sum(later > losses[0] for later in losses) > 3
    assert len({row["step_size_um"] for row in rows}) == 1
