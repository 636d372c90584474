"""Designs: their variables, limits, gradients, and that each method improves a lens."""

import copy
import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from examples import changed, f64, materials, random_lens, random_pictures, tiny_study
from torch import nn

from tasklens import jobs
from tasklens.checkpoints import NOTHING_KEPT
from tasklens.design import descent, methods
from tasklens.design.constraints import (
    first_order_margins,
    manufacturing_margins,
    penalty,
    shortfall,
    worst_margin,
)
from tasklens.design.divergence import cause
from tasklens.design.schedule import cosine
from tasklens.design.start import Variables, flat, parameter_groups, view
from tasklens.design_settings import EndToEnd, Rates
from tasklens.imaging import Camera
from tasklens.optics.analysis import chief_points, clear_semi_diameters, trace_fields
from tasklens.optics.paraxial import paraxial
from tasklens.optics.psf import psf
from tasklens.optics.pupil import sobol_disc
from tasklens.settings import Capture, Constraints, Spec
from tasklens.study import parse

SPEC, LIMITS = Spec(kernel=11), Constraints()
LOOKS = view(SPEC)
NAMES = ("COC", "OKP4")
PLASTICS = materials(*NAMES)


# ---- starts and variables


@pytest.mark.parametrize("elements", [1, 2, 3, 4])
def test_flat_start_keeps_the_limits_and_has_no_power(elements):
    """Plane plates that can be made, a stop of EFL / (2 F), nothing bent."""
    lens = flat(materials("COC") * elements, SPEC, LIMITS)
    assert float(paraxial(lens, 0.5893).power) == 0
    assert float(lens.semi_diameter[lens.stop]) == pytest.approx(SPEC.efl_mm / (2 * SPEC.f_number), rel=1e-15)
    margins = manufacturing_margins(lens, LIMITS, torch.full_like(lens.thickness, 1.5))
    del margins["max_centre_thickness"]  # few plates fill the track with thick glass
    assert worst_margin(margins)[1] >= 0


def test_variables_there_and_back():
    """Assembling what was taken out changes nothing; assembling other values changes these and no others."""
    lens = random_lens(0)
    variables = Variables.plain(lens)
    same = variables.assemble(variables.values())
    for name in ("curvature", "conic", "alpha", "thickness", "semi_diameter"):
        assert torch.equal(getattr(same, name), getattr(lens, name)), name
    values = {name: torch.full_like(v, 0.1 * k) for k, (name, v) in enumerate(variables.values().items(), 1)}
    again = Variables.plain(variables.assemble(values)).values()
    assert all(torch.equal(values[name], again[name]) for name in values)
    other = variables.assemble(values)
    assert torch.equal(other.alpha[:, 0], lens.alpha[:, 0]) and torch.equal(other.conic, lens.conic)
    assert other.thickness[0] == lens.thickness[0] and other.curvature[0] == lens.curvature[0]
    partial = variables.assemble({"curvature": values["curvature"]})
    assert torch.equal(partial.thickness, lens.thickness) and torch.equal(partial.alpha, lens.alpha)


def test_normalised_variables_are_slopes_at_the_radius_that_light_uses():
    """alpha_2j R^(2j - 1) is 1 / (2j) of the slope that the term has at R; taking out and putting in is exact."""
    lens, used = random_lens(0), f64([0.3, 0.4, 0.7, 1.1, 1.9])
    variables = Variables(lens, used)
    for order in (4, 6, 8, 10):
        r = used.clone().requires_grad_()
        slope = torch.autograd.grad((lens.alpha[:, order // 2 - 1] * r**order).sum(), r)[0]
        torch.testing.assert_close(variables.values()[f"alpha_{order}"], slope[1:] / order, rtol=1e-13, atol=0)
    torch.testing.assert_close(variables.assemble(variables.values()).alpha, lens.alpha, rtol=1e-14, atol=0)


def test_each_asphere_order_learns_more_slowly_by_one_factor():
    values = Variables.plain(random_lens(0)).values()
    groups = parameter_groups(values, Rates(curvature=1, thickness=2, alpha_4=3, decay=0.5))
    assert [group["lr"] for group in groups] == [1, 2, 3, 1.5, 0.75, 0.375]
    assert [group["params"][0] is value for group, value in zip(groups, values.values(), strict=True)] == [True] * 6


def test_cosine_schedule():
    """From 1 to the final fraction, their mean half-way, symmetric about it."""
    assert [cosine(x, 0.2) for x in (0, 0.5, 1, 2)] == pytest.approx([1, 0.6, 0.2, 0.2])
    assert cosine(0.3, 0.2) + cosine(0.7, 0.2) == pytest.approx(1.2)
    assert cosine(0.7, 1.0) == 1


# ---- limits


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
    """Spheres and plates whose shortfall is known in closed form; the other limits hold."""
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
    """An element is moulded up to where light leaves either surface; the other is flat beyond its own light."""
    lens, _ = BROKEN["min_edge_thickness"]
    margins = manufacturing_margins(lens, LIMITS, f64(semi))
    expected = 0.4 - sphere_sag(R, SEMI) - sphere_sag(R, 0.6) - 0.2
    assert float(margins["min_edge_thickness"].min()) == pytest.approx(expected, abs=1e-12)


def test_elements_that_overlap_only_between_axis_and_rim_are_found():
    """Air gaps are checked at several heights: aspheres may touch where neither vertex nor edge shows it."""
    alpha = torch.zeros(5, 5, dtype=torch.float64)
    alpha[3, 0], alpha[3, 1] = -0.64, 1.0  # sag r^2 (r^2 - 0.64): zero at the vertex and at r = 0.8, -0.1 between
    base = flat(PLASTICS, SPEC, LIMITS)
    lens = replace(base, alpha=alpha, thickness=f64([0.1, 0.8, 0.1, 0.8, 1.5]))
    margins = manufacturing_margins(lens, LIMITS, torch.full((5,), 0.8, dtype=torch.float64))
    assert float(margins["min_air_gap"].min()) == pytest.approx(0.1 - 0.32**2 - 0.05, abs=2e-3)


def test_focal_length_and_distortion_margins(start):
    """A lens 5 % too long, and chief rays 6 % too far out, miss their limits of 2 and 3 % by the rest."""
    longer = replace(LOOKS, efl=LOOKS.efl / 1.05)
    margins = first_order_margins(start, LIMITS, longer, 1.06 * longer.fields)
    assert float(margins["efl_tolerance"]) == pytest.approx(0.02 - (1 - 1 / 1.05), abs=1e-9)
    torch.testing.assert_close(margins["distortion"], torch.full((8,), 0.03 - 0.06, dtype=torch.float64))


def test_penalty_is_zero_inside_and_pushes_outward():
    """Steepest descent of the penalty thickens a plate that is too thin and flattens a surface that is too steep."""
    limits = LIMITS.model_copy(update={"efl_tolerance": 9.0, "distortion": 9.0})  # plates have no focal length
    good = plates([0.2, 0.9, 2.0])
    assert float(penalty(good, limits, LOOKS)) == 0

    def slope(lens, name):
        leaf = getattr(lens, name).clone().requires_grad_()
        return torch.autograd.grad(penalty(replace(lens, **{name: leaf}), limits, LOOKS), leaf)[0]

    assert slope(plates([0.2, 0.1, 2.0]), "thickness")[1] < 0
    assert slope(plates([0.2, 1.0, 3.5]), "thickness").min() > 0  # track: every space shrinks
    for sign in (1, -1):
        assert sign * slope(plates([0.6, 1.0, 2.0], [0, sign / 1.1, 0]), "curvature")[1] > 0
    assert float(penalty(good, LIMITS, LOOKS)) > 0.9  # no power instead of all of it


def test_shortfall_begins_before_the_limit():
    """Designs aim a buffer inside: at the limit itself the shortfall is already positive, far inside it is zero."""
    found = shortfall({"min_air_gap": f64([0.0, 1.0, -0.5]), "distortion": f64([0.0])})
    assert found[0] > 0 and found[1] == 0 and float(found[2] - found[0]) == pytest.approx(0.5)
    assert 0 < found[3] < found[0]


# ---- descent of a classifier's loss


def small_network(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    layers = nn.Conv2d(3, 6, 3, stride=2), nn.BatchNorm2d(6), nn.ReLU(), nn.AdaptiveAvgPool2d(2), nn.Flatten()
    return nn.Sequential(*layers, nn.Linear(24, 3))


def coarse(lens, looks=LOOKS):
    """PSFs on coarse pixels, where light of a bad lens falls into the window."""
    rays = trace_fields(lens, looks, sobol_disc(32, 0))
    return psf(rays, looks.fields, 20.0, 11)


@pytest.mark.parametrize("colour", ["srgb", "linear"])
@pytest.mark.parametrize("micro_batch", [1, 7, 16, 64])
def test_stages_give_the_gradient_of_one(start, micro_batch, colour):
    """dL/dPSF from micro-batches of 45 captures, carried through the rays, equals backward through all at once."""
    pictures, network = random_pictures(5, 16, 3, seed=0), small_network().eval().requires_grad_(False)
    images, labels = pictures.batch(torch.arange(5))
    variables = Variables.plain(start)
    gradients = []
    for in_stages in (True, False):
        values = {name: v.requires_grad_() for name, v in variables.values().items()}
        grid = coarse(variables.assemble(values))
        if in_stages:
            losses, upstream = descent.loss_at_psf(
                network, images, labels, grid.float(), Capture(colour=colour), micro_batch
            )
            grid.backward(upstream.double())
        else:
            logits = network(Camera(grid, colour=colour).grid(images).flatten(0, 1))
            whole = F.cross_entropy(logits, labels.repeat(len(grid)))
            whole.backward()
        gradients.append(torch.cat([values[name].grad for name in values]))
    each = F.cross_entropy(logits, labels.repeat(len(grid)), reduction="none").reshape(9, 5).mean(1).detach()
    torch.testing.assert_close(losses, each, rtol=1e-5, atol=0)
    assert float(gradients[1].abs().max()) > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-5 * float(gradients[1].abs().max()))


RATES = Rates(curvature=1e-2, thickness=5e-3, alpha_4=1e-2, decay=0.5)


def problem(limits=LIMITS):
    return descent.Problem(LOOKS, limits, Capture(), random_pictures(12, 16, 3, seed=0), seed=1)


def descended(network, lens, checkpoint=NOTHING_KEPT, **settings):
    settings = {"steps": 3, "images": 4, "rays": 16, "rates": RATES, "network_rate": 1e-3} | settings
    history: list[dict] = []
    settings = EndToEnd(method="end_to_end", start="flat", **settings)
    return descent.descend(lens, network, problem(), settings, history, "test", checkpoint), history


def test_a_design_may_see_smaller_pictures(start):
    """Reduced to `size` by averaging; without it, as they are."""
    pictures = random_pictures(4, 32, 3, seed=0)
    indices = torch.tensor([2, 0])
    whole, labels = descent.sharp(pictures, indices, None)
    assert torch.equal(whole, pictures.images[indices]) and torch.equal(labels, pictures.labels[indices])
    small, _ = descent.sharp(pictures, indices, 16)
    assert small.shape == (2, 3, 16, 16) and small.dtype == torch.uint8
    means = (images.double().mean((1, 2, 3)) for images in (small, pictures.images[indices]))
    torch.testing.assert_close(*means, rtol=0, atol=2.0)
    noise = (images.double().std((1, 2, 3)) for images in (small, whole))
    assert (next(noise) < 0.7 * next(noise)).all()


def test_end_to_end_design_moves_the_network_too(start):
    network = small_network()
    before = copy.deepcopy(network.state_dict())
    lens, _ = descended(network, start)
    assert all(not torch.equal(v, before[k]) for k, v in network.state_dict().items())
    assert not torch.equal(lens.curvature, start.curvature)
    assert not network.training


def test_descent_is_deterministic(start):
    first, again = (descended(small_network(), start)[0] for _ in range(2))
    for name in ("curvature", "thickness", "alpha"):
        assert torch.equal(getattr(first, name), getattr(again, name))


def test_cold_start_shrinks_pixels_and_opens_the_stop(start):
    """Both scales go to 1 in equal ratios by the end of their durations, and stay there."""
    settings = {"pixel_scale": 16.0, "pixel_duration": 0.5, "stop_scale": 0.25, "stop_duration": 0.25}
    _, history = descended(small_network(), start, steps=8, cold_start=settings)
    assert [row["pixel_scale"] for row in history] == pytest.approx([16, 8, 4, 2, 1, 1, 1, 1])
    assert [row["stop_scale"] for row in history] == pytest.approx([0.25, 0.5, 1, 1, 1, 1, 1, 1])


def test_a_design_that_diverges_is_a_result(start):
    """Steps without measure: the descent stops, the last finite lens comes back, and the history says so."""
    rates = Rates(curvature=1e200, thickness=1e200, alpha_4=1e200, decay=1.0)
    lens, history = descended(small_network(), start, steps=6, rates=rates)
    assert history[-1]["phase"] == "test, diverged" and history[-1]["step"] <= 6
    assert history[-1]["cause"].startswith("no field;")  # the penalty overflowed
    for name in ("curvature", "thickness", "alpha"):
        assert torch.isfinite(getattr(lens, name)).all()


def test_the_cause_of_a_divergence_has_a_name(start):
    """The field whose loss broke, and the surface whose numbers did; or the network, where neither did."""
    pupil, losses = sobol_disc(16, 0), torch.zeros(9)
    losses[[2, 5]] = torch.nan
    x, y = LOOKS.fields[2].tolist()
    assert cause(start, LOOKS, pupil, losses) == (
        f"field 2 at ({x:.3f}, {y:.3f}) mm; all surfaces and rays are finite, the network or a limit is not"
    )
    alpha = start.alpha.clone()
    alpha[3, 1] = torch.inf
    broken = replace(start, alpha=alpha)
    assert cause(broken, LOOKS, pupil, torch.zeros(9)) == "no field; surface 3 has a shape that is not finite"


def test_finished_lens_passes_its_light_and_tells_its_margins(start):
    study = parse(changed(tiny_study(), "elements", {"doublet": NAMES}))
    job = jobs.design(study, "doublet-imaging1", 0)
    lens, notes = methods.finished(start, 1.5 * clear_semi_diameters(start, LOOKS), job, {"method": "spot"})
    assert torch.isfinite(lens.semi_diameter).all()
    assert float(lens.semi_diameter[0]) == study.spec.stop_radius_mm
    valid = trace_fields(start, LOOKS, sobol_disc(64, 0)).valid.double().mean((1, 2)).tolist()
    assert notes["figures"]["valid_fraction"] == pytest.approx(valid, abs=1e-12)
    assert notes["figures"]["efl_mm"] == pytest.approx(study.spec.efl_mm, rel=1e-9)
    assert notes["worst_margin"]["value"] == min(notes["margins"].values())
    assert len(notes["margins"]) == 9
    assert chief_points(lens, LOOKS).isfinite().all()
    reopened = methods.open_apertures(lens)
    assert torch.equal(reopened.semi_diameter, start.semi_diameter)


def test_rays_that_go_astray_are_stopped(start):
    """A clear aperture that light would use a little more of cuts what is outside, and limits are asked within it."""
    job = jobs.design(parse(changed(tiny_study(), "elements", {"doublet": NAMES})), "doublet-imaging1", 0)
    used = clear_semi_diameters(start, LOOKS)
    clear = used.clone()
    clear[-1] *= 0.97
    whole, cut = (methods.finished(start, each, job, {}) for each in (1.01 * used, clear))
    fractions = [sum(notes["figures"]["valid_fraction"]) for _, notes in (whole, cut)]
    assert 0.8 * fractions[0] < fractions[1] < fractions[0]
    assert torch.equal(cut[0].semi_diameter[1:], clear[1:])
    assert cut[1]["margins"]["max_slope"] >= whole[1]["margins"]["max_slope"]


def test_best_rival_is_chosen_by_the_minival(tmp_path):
    """The test split has no say."""
    rivals = {}
    for name, minival, test in (("a", 40, 90), ("b", 60, 10), ("c", 50, 99)):
        path = tmp_path / f"{name}.csv"
        rows = "\n".join(f"{field},minival_accuracy,{minival}\n{field},accuracy,{test}" for field in range(9))
        path.write_text(f"field,metric,value\n{rows}\n")
        rivals[name] = (None, path)
    assert methods.best(rivals) == "b"
