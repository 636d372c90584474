"""Descent on a classifier's loss, and properties of every finished design."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from designs import LEARNING_RATES, LIMITS, VIEW, adamw_descent, tiny_network
from examples import random_images
from studies import changed, tiny_study
from torch import nn

from tasklens.camera.imaging import PsfCamera
from tasklens.design import methods
from tasklens.design.criteria import TaskLoss, loss_at_psf
from tasklens.design.descent import divergence
from tasklens.design.image_quality import ImageError
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.design.variables import Variables
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, clear_semi_diameters, trace_fields
from tasklens.optics.psf import psf
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import LearningRates
from tasklens.study.loading import parse
from tasklens.study.table_contents import lens_design

pytestmark = pytest.mark.usefixtures("few_rays")


def coarse_psfs(lens, view=VIEW):
    """PSFs on coarse pixels, so that the light of a bad lens falls into the window."""
    rays = trace_fields(lens, view, sobol_disc(32, 0))
    return psf(rays, view.fields, 20.0, 11)


def whole_losses(criterion, captures, images, labels):
    """Losses (F, B) of all captures, by the definition of each criterion."""
    if isinstance(criterion, TaskLoss):
        logits = criterion.network(captures.flatten(0, 1))
        return F.cross_entropy(logits, labels.repeat(len(captures)), reduction="none").reshape(captures.shape[:2])
    squared = ((captures - images) ** 2).mean((2, 3, 4))
    return squared.log() if criterion.logarithm else squared


@pytest.mark.parametrize(
    "supervised_by, micro_batch, colour",
    [("classifier", 7, "srgb"), ("classifier", 64, "linear"), ("image", 7, "linear"), ("log image", 7, "srgb")],
)
def test_stages_give_the_gradient_of_one(start, supervised_by, micro_batch, colour):
    """dL/dPSF from micro-batches of 45 captures, carried through the rays, equals backward through all at once.

    Micro-batches may split fields; the loss is the weighted mean of the fields.
    """
    dataset, network = random_images(5, 16, 3, seed=0), tiny_network().eval().requires_grad_(False)
    criterion = TaskLoss(network) if supervised_by == "classifier" else ImageError("log" in supervised_by)
    images, labels = dataset.batch(torch.arange(5))
    variables, weights = Variables.plain(start), torch.linspace(0.5, 1.5, 9)
    gradients = []
    for in_stages in (True, False):
        values = {name: v.requires_grad_() for name, v in variables.values().items()}
        grid = coarse_psfs(variables.assemble(values))
        if in_stages:
            options = images, labels, grid.float(), CaptureSettings(colour=colour), micro_batch
            losses, upstream = loss_at_psf(criterion, *options, weights=weights)
            grid.backward(upstream.double())
        else:
            captures = PsfCamera(grid, colour=colour).all_fields(images)
            direct = whole_losses(criterion, captures, images, labels).mean(1) * weights
            direct.mean().backward()
        gradients.append(torch.cat([values[name].grad for name in values]))
    torch.testing.assert_close(losses, direct.detach().to(losses), rtol=1e-5, atol=0)
    assert float(gradients[1].abs().max()) > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-5 * float(gradients[1].abs().max()))


class Contrast(nn.Module):
    """A network whose first logit is the image contrast: it sees only blur."""

    def forward(self, images):
        contrast = (images - F.avg_pool2d(images, 3, 1, 1)).square().mean((1, 2, 3))
        return torch.stack([1000 * contrast, 0 * contrast, 0 * contrast], 1)


def test_a_design_may_see_smaller_images(start):
    """Images are averaged down to `size`; without `size` they stay as they are."""
    dataset = random_images(4, 32, 3, seed=0)
    indices = torch.tensor([2, 0])
    sharp = Problem(VIEW, LIMITS, 0, CaptureSettings(), dataset)
    whole, labels = Objective(TaskLoss(tiny_network()), sharp, None, False, 1).images(indices, augment=False)
    assert torch.equal(whole, dataset.images[indices].float() / 255) and torch.equal(labels, dataset.labels[indices])
    small, _ = Objective(TaskLoss(tiny_network()), sharp, 16, False, 1).images(indices, augment=False)
    assert small.shape == (2, 3, 16, 16)
    means = (images.double().mean((1, 2, 3)) for images in (small, whole))
    torch.testing.assert_close(*means, rtol=0, atol=2.0 / 255)
    noise = (images.double().std((1, 2, 3)) for images in (small, whole))
    assert (next(noise) < 0.7 * next(noise)).all()


class Confident(Contrast):
    """`Contrast` with a trainable bias of the answer, so that training lowers the loss whatever the lens does."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, images):
        return super().forward(images) + torch.stack([self.weight, 0 * self.weight, 0 * self.weight])


def test_a_network_that_learns_does_not_hide_that_its_lens_is_destroyed(start):
    """The loss is least at the end, since the network has learned; the lens is still the one with the least blur."""
    options = {"steps": 12, "learning_rates": LEARNING_RATES.model_copy(update={"curvature": 1.0}), "classes": 1}
    lens, history = adamw_descent(Confident(), start, network_learning_rate=0.5, **options)
    validated = [row["validation_loss"] for row in history]
    assert min(validated) == validated[-1] < validated[0] - 0.1
    blur = {"network_learning_rate": None, "steps": 2, "classes": 1}
    histories = [adamw_descent(Contrast(), candidate, **blur)[1] for candidate in (start, lens)]
    before, after = (history[0]["validation_loss"] for history in histories)
    assert after <= before + 1e-9


def test_cold_start_shrinks_pixels_and_opens_the_stop(start):
    """Both scales go to 1 in equal ratios by the end of their durations, and stay there."""
    scales = {"pixels": (16.0, 1.0), "duration": 0.5, "stop_scale": 0.25, "stop_duration": 0.25}
    _, history = adamw_descent(tiny_network(), start, steps=8, **scales)
    assert [row["pixel_scale"] for row in history] == pytest.approx([16, 8, 4, 2, 1, 1, 1, 1])
    assert [row["stop_scale"] for row in history] == pytest.approx([0.25, 0.5, 1, 1, 1, 1, 1, 1])


def test_a_design_that_diverges_is_a_result(start):
    """With huge steps the descent stops, returns the last finite lens, and the history says so."""
    rates = LearningRates.model_construct(curvature=1e200, thickness=1e200, alpha_4=1e200, decay=1.0, normalised=True)
    lens, history = adamw_descent(tiny_network(), start, steps=6, learning_rates=rates)
    assert history[-1]["phase"] == "descent 1, diverged" and history[-1]["step"] <= 6
    assert history[-1]["cause"].startswith("no field;")  # the penalty overflowed
    for name in ("curvature", "thickness", "alpha"):
        assert torch.isfinite(getattr(lens, name)).all()


class Broken(nn.Module):
    """A network with finite logits and a NaN gradient: zero times the slope of a square root at zero."""

    def forward(self, images):
        return (0 * images).sum((1, 2, 3)).sqrt()[:, None].repeat(1, 3)


def test_a_lens_of_nan_is_not_the_best(start):
    """Its grey captures may have a smaller loss than plates, and no limit is violated."""
    lens, history = adamw_descent(Broken(), start, network_learning_rate=None)
    assert history[-1]["phase"] == "descent 1, diverged"
    for name in ("curvature", "thickness", "alpha"):
        assert torch.equal(getattr(lens, name), getattr(start, name))


def test_the_cause_of_a_divergence_has_a_name(start):
    """The field whose loss broke, and the surface whose numbers did; or the network, if neither did."""
    pupil, losses = sobol_disc(16, 0), torch.zeros(9)
    losses[[2, 5]] = torch.nan
    x, y = VIEW.fields[2].tolist()
    assert str(divergence(start, VIEW, pupil, losses)) == (
        f"field 2 at ({x:.3f}, {y:.3f}) mm; all surfaces and rays are finite; the network or a limit is not"
    )
    alpha = start.alpha.clone()
    alpha[3, 1] = torch.inf
    broken = replace(start, alpha=alpha)
    cause = str(divergence(broken, VIEW, pupil, torch.zeros(9)))
    assert cause == "no field; the shape of surface 3 is not finite"


@pytest.fixture
def job_settings():
    """Settings of the job that designs a doublet."""
    return lens_design(parse(changed(tiny_study(), "elements", {"doublet": ["COC", "OKP4"]})), "doublet-imaging1", 0)


def test_finished_lens_passes_its_light_and_tells_its_margins(start, job_settings):
    lens, notes = methods.with_notes(start, 1.5 * clear_semi_diameters(start, VIEW), job_settings, {"method": "spot"})
    assert torch.isfinite(lens.semi_diameter).all()
    assert float(lens.semi_diameter[0]) == job_settings.spec.stop_radius_mm
    valid = trace_fields(start, VIEW, sobol_disc(64, 0)).valid.double().mean((1, 2)).tolist()
    assert notes["figures"]["valid_fraction"] == pytest.approx(valid, abs=1e-12)
    assert notes["figures"]["efl_mm"] == pytest.approx(job_settings.spec.efl_mm, rel=1e-9)
    assert notes["worst_margin"]["value"] == min(notes["margins"].values())
    assert len(notes["margins"]) == 9
    assert chief_points(lens, VIEW).isfinite().all()
    assert torch.equal(lens.with_open_apertures().semi_diameter, start.semi_diameter)


def test_rays_that_go_astray_are_stopped(start, job_settings):
    """A clear aperture slightly below the beam cuts the outer rays, and limits apply within it."""
    semi_diameters = clear_semi_diameters(start, VIEW)
    clear = semi_diameters.clone()
    clear[-1] *= 0.97
    apertures = 1.01 * semi_diameters, clear
    whole, cut = (methods.with_notes(start, aperture, job_settings, {}) for aperture in apertures)
    fractions = [sum(notes["figures"]["valid_fraction"]) for _, notes in (whole, cut)]
    assert 0.8 * fractions[0] < fractions[1] < fractions[0]
    assert torch.equal(cut[0].semi_diameter[1:], clear[1:])
    assert cut[1]["margins"]["max_slope"] >= whole[1]["margins"]["max_slope"]
