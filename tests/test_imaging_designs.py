"""Imaging designs: spot descent; the merit function, its derivatives, and the search that lowers it."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
from designs import LIMITS, NO_LIMITS, SPEC, VIEW
from examples import difference, make_lens, materials

from tasklens.design import least_squares
from tasklens.design.merit import FIELD_HEIGHTS, VIOLATION_UM_PER_MM, Merit
from tasklens.design.problem import Problem
from tasklens.design.start import flat, random_starts
from tasklens.design.variables import Variables
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, centroid, rms_spot_radius, smallest_aperture, trace_fields
from tasklens.runtime.errors import InputError
from tasklens.settings.least_squares_settings import LeastSquaresSettings

PROBLEM = Problem(VIEW, LIMITS, 0)
PLASTICS = materials("COC", "OKP4")


def test_limits_without_any_start_are_named():
    """A singlet of F/2.8 needs a steeper surface."""
    plates = flat(materials("COC"), SPEC, LIMITS)
    flatter = LIMITS.model_copy(update={"max_slope": 0.15})
    with pytest.raises(InputError, match=r"max_slope = 0\.15"):
        random_starts(plates, VIEW, flatter, 1, numpy.random.default_rng(0))


def test_random_starts_have_the_focal_length_and_a_focus():
    """The last curvature and the back focus are solved for; limits on track and back focus hold."""
    plates = flat(PLASTICS, SPEC, LIMITS)
    starts = random_starts(plates, VIEW, LIMITS, 20, numpy.random.default_rng(3))
    again = random_starts(plates, VIEW, LIMITS, 20, numpy.random.default_rng(3))
    for lens, repeated in zip(starts, again, strict=True):
        first_order = paraxial(lens, VIEW.wavelengths_um[1])
        assert float(first_order.efl) == pytest.approx(VIEW.efl, rel=1e-12)
        assert float(first_order.bfl) == pytest.approx(float(lens.thickness[-1]), rel=1e-12)
        assert LIMITS.min_back_focus < float(first_order.bfl) and float(lens.thickness.sum()) < LIMITS.max_track
        assert torch.equal(lens.curvature, repeated.curvature)
    assert len({float(lens.curvature[1]) for lens in starts}) == 20


@pytest.mark.parametrize("reference", ["centroid", "chief_ray", "pinhole"])
def test_merit_columns_are_the_limit_of_differences(start, reference):
    """Rays with either reference, and all limits with the apertures of the rays; every kind is violated."""
    limits = LIMITS.model_copy(update={"efl_tolerance": 1e-4, "distortion": 1e-4, "max_slope": 0.1})
    limits = limits.model_copy(
        update={"min_edge_thickness": 2.0, "min_back_focus": 9.0, "min_air_gap": 1.0, "max_chief_ray_angle_deg": 5.0}
    )
    lens = replace(start, curvature=1.01 * start.curvature)
    merit = Merit(VIEW, limits, reference)
    variables = Variables.plain(lens)
    values = variables.values()

    def residuals(vector):
        return merit.residuals(variables.assemble_vector(list(values), vector))

    vector = torch.cat(list(values.values()))
    columns = merit.linearise(lens)[1](variables.directions(values))
    expected = difference(residuals, vector, 1e-6)
    errors = merit.rays
    first_order = 1 + 2 * (len(FIELD_HEIGHTS) - 1)  # focal length, then distortion and chief-ray angles off the axis
    assert (expected[:errors].abs().amax(0) > 1).all() and (expected[-first_order:].abs().amax(1) > 1).sum() > 9
    assert (expected[errors:-first_order].abs().amax(1) > 1).sum() > 60
    torch.testing.assert_close(columns, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))


def test_rays_follow_a_stop_that_is_a_surface_of_a_lens():
    """They begin on it, wherever its curvature puts it."""
    lens = make_lens([0.5, -0.15], [1.0, 3.0], ("COC", "air"), semi_diameter=[0.5, torch.inf])
    merit, changed = Merit(VIEW, LIMITS), replace(lens, curvature=1.3 * lens.curvature)
    merit.residuals(lens)
    assert torch.equal(merit.residuals(changed), Merit(VIEW, LIMITS).residuals(changed))


def test_merit_is_the_mean_square_spot(start):
    """If no limit is violated, the sum of squares is the mean over fields of the squared RMS spot radius."""
    merit = Merit(VIEW, NO_LIMITS, "centroid")
    gentle = start.with_stop_scaled(0.3)
    mean_square = float(merit.residuals(gentle).square().sum())
    heights = torch.tensor(FIELD_HEIGHTS, dtype=torch.float64)
    fields = torch.stack([0 * heights, heights * VIEW.fields.norm(dim=-1).max()], -1)
    view = replace(VIEW, fields=fields)
    rays = trace_fields(gentle, view, sobol_disc(8192, 0))
    expected = float((1e3 * rms_spot_radius(rays, centroid(rays))).square().mean())
    assert mean_square == pytest.approx(expected, rel=1e-2)


@pytest.fixture(scope="module")
def search():
    """A lens by a search of a few seconds, and its history."""
    return searched()


def searched(**settings) -> tuple:
    settings = LeastSquaresSettings(method="least_squares", starts=6, evaluations=120, **settings)
    return least_squares.design(flat(PLASTICS, SPEC, LIMITS), PROBLEM, settings)


def test_a_search_makes_a_better_lens(search):
    """The search halves the merit of its best start, and perturbations lower it further."""
    lens, history = search
    starts = random_starts(flat(PLASTICS, SPEC, LIMITS), VIEW, LIMITS, 6, numpy.random.default_rng(0))
    merit = Merit(VIEW, LIMITS, "centroid")
    best = min(float(merit.residuals(x).norm()) for x in starts)
    final = float(merit.residuals(lens).norm())
    assert final < 0.5 * best
    assert history[-2]["rms_um"] < min(row["rms_um"] for row in history if row["stage"] == "4 orders")
    strict = Merit(VIEW, LIMITS, per_mm=20 * VIOLATION_UM_PER_MM, reference="centroid")
    assert float(strict.residuals(lens).norm()) == pytest.approx(history[-1]["rms_um"], rel=1e-9)


def test_a_search_uses_one_thread(search, two_threads):
    """So the lens does not depend on the number of cores."""
    lens, history = searched()
    assert torch.equal(lens.alpha, search[0].alpha) and history == search[1]


def test_a_perturbation_that_makes_it_worse_is_forgotten(monkeypatch):
    """Two evaluations from plane plates give nothing better, so the earlier lens is returned."""
    plates = flat(PLASTICS, SPEC, LIMITS)
    settings = LeastSquaresSettings(method="least_squares", starts=6, evaluations=100)
    monkeypatch.setattr(least_squares, "_perturb", lambda lens, rng: plates)
    monkeypatch.setattr(least_squares, "_PERTURBATION_EVALUATIONS", 2)
    _, history = least_squares.design(plates, PROBLEM, settings)
    unperturbed = min(row["rms_um"] for row in history if row["stage"] == "4 orders")
    assert history[-2]["rms_um"] == unperturbed


def test_an_aperture_stops_what_it_may_and_nothing_on_the_axis():
    """Of heights 1 to 10 with equal light, 30 % may be stopped: 7 passes; the axis may lose nothing, so 8 passes."""
    heights = torch.arange(1.0, 11.0)[torch.randperm(10, generator=torch.Generator().manual_seed(0))]
    weight = torch.full((10,), 0.1)
    low = 0.5 * heights
    for axial, expected in ((torch.tensor([2.0]), 7), (torch.tensor([2.0, 8.0]), 8)):
        beams = torch.stack([low, heights])[:, None]
        assert float(smallest_aperture(beams, weight, axial, 0.3)) == expected
    lost = heights.masked_fill(heights > 6, torch.inf)  # then nothing more may be stopped
    assert math.isinf(smallest_aperture(lost[None, None], weight, heights[:1], 0.3))


def test_a_lens_that_may_vignette_makes_a_smaller_spot(search, monkeypatch):
    """After the same search: no field loses more than its limit, the axis loses nothing, and the spots shrink."""
    pupil = torch.cat([OUTLINE, sobol_disc(1024, 5)])
    results = []
    monkeypatch.setattr(least_squares, "_STRICT_EVALUATIONS", 8)
    vignetted = searched(vignetting=0.4)
    for lens, _ in (search, vignetted):
        rays = trace_fields(lens, VIEW, pupil)
        results.append((float(rms_spot_radius(rays, centroid(rays)).square().mean()), rays.valid.double().mean((1, 2))))
    assert vignetted[1][-1]["stage"] == "vignetting" and lens.semi_diameter[1:].isfinite().sum() == 1
    assert (results[0][1] == 1).all() and results[1][0] < results[0][0]
    assert (results[1][1][VIEW.radii == 0] == 1).all()
    assert float(results[1][1].min()) == pytest.approx(0.6, abs=0.02)


def test_a_lost_ray_has_a_large_residual(start):
    """Otherwise the search could shrink spots by losing rays."""
    merit = Merit(VIEW, LIMITS)
    dark = replace(start, semi_diameter=torch.where(torch.arange(len(start.media)) == 2, 1e-6, start.semi_diameter))
    assert float(merit.residuals(dark)[: merit.rays].square().sum()) == pytest.approx(2 * 300**2)  # um, in x and y
