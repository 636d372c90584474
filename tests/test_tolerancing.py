"""Errors of manufacture: built lenses, their focus, sensitivities against traced rays and statistics."""

import math
from dataclasses import replace

import pytest
import torch
from examples import cooke_triplet, f64, make_lens
from tolerance_examples import AIR, COC, OKP4, doublet, grade

from tasklens.materials.material import D_LINE
from tasklens.optics.analysis import focus
from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, distances, encircled_energy_radius, trace_fields
from tasklens.optics.lens import Lens, Melt
from tasklens.optics.tolerancing.manufacturing_errors import DEVIATION, draw, elements, errors, with_errors
from tasklens.optics.tolerancing.monte_carlo import MonteCarlo
from tasklens.optics.tolerancing.sensitivity import displacements, traced_displacements
from tasklens.optics.view import View
from tasklens.settings.tolerance_settings import GRADES, Grade

# ---- errors and lenses


def test_elements_are_what_lies_between_air():
    lens = cooke_triplet()
    assert elements(lens) == [(0, 1), (2, 3), (5, 6), (7, 8)]
    assert elements(doublet()[0]) == [(1, 2), (3, 4)]
    cemented = make_lens([0.1, -0.1, 0.05], [1.0, 1.0, 9.0], (COC, OKP4, AIR), semi_diameter=[1.0] * 3)
    assert elements(cemented) == [(0, 2)]
    names = [error.name for error in errors(cemented, grade(surface_decentre_um=1.0, index=0.001, thickness_um=5.0))]
    assert names == ["thickness 0", "index 0", "thickness 1", "index 1",
                     *(f"surface decentre {i} {axis}" for i in (1, 2) for axis in "xy")]  # fmt: skip


def test_a_stop_inside_a_glass_has_no_errors():
    """A rod with its stop in the middle is one piece of glass, with one thickness and one index."""
    rod = make_lens([0.1, 0.0, -0.1], [2.0, 3.0, 9.0], (COC, COC, AIR), semi_diameter=[1.0] * 3, stop=1)
    all_errors = errors(rod, grade(surface_decentre_um=1.0, index=0.001, thickness_um=5.0, radius_percent=1.0))
    names = ["radius 0", "radius 2", "thickness 0", "index 0", "surface decentre 2 x", "surface decentre 2 y"]
    assert [error.name for error in all_errors] == names
    melted = with_errors(rod, all_errors, torch.eye(len(names), dtype=torch.float64)[3], 0.55)
    change = melted.refractive_indices((0.55,)) - rod.refractive_indices((0.55,))
    torch.testing.assert_close(change[:, 0], f64([0, 0.001, 0.001, 0]), rtol=1e-6, atol=1e-12)


def test_every_kind_of_error_is_listed_once():
    all_errors = errors(doublet()[0], Grade.model_validate("precision_moulding"))
    assert len({error.name for error in all_errors}) == len(all_errors) == 4 + 8 + 2 + 2 + 4 + 8 + 8
    assert not any("radius 0" in error.name or "form 0" in error.name for error in all_errors)  # the stop
    assert {error.kind for error in errors(doublet()[0], grade(index=0.001))} == {"index"}


def test_drawn_errors_are_normal_and_cut():
    """Two standard deviations are the tolerance; more lenses begin with the same ones; another seed, others."""
    all_errors = errors(doublet()[0], Grade.model_validate("precision_moulding"))
    fractions = draw(all_errors, 4000, 3)
    assert fractions.abs().max() <= 1.0 and fractions.abs().max() > 0.99
    assert float(fractions.std()) == pytest.approx(DEVIATION, rel=0.01) and abs(float(fractions.mean())) < 0.005
    expected = math.erf(math.sqrt(0.5)) / math.erf(math.sqrt(2))
    assert float((fractions.abs() < 0.5).double().mean()) == pytest.approx(expected, abs=0.005)
    same, other = (draw(all_errors, 10, seed) for seed in (3, 4))
    assert torch.equal(same, fractions[:10]) and not torch.equal(other, fractions[:10])


def test_a_lens_without_errors_is_the_design():
    lens, view = doublet()
    all_errors = errors(lens, Grade.model_validate("commercial_moulding"))
    perfect = with_errors(lens, all_errors, torch.zeros(len(all_errors), dtype=torch.float64), view.reference_um)
    pupil = sobol_disc(64, seed=0)
    rays, expected = trace_fields(perfect, view, pupil), trace_fields(lens, view, pupil)
    torch.testing.assert_close(rays.x, expected.x, rtol=0, atol=1e-14)
    assert focus.peak(perfect, view) == pytest.approx(float(focus.peak(lens, view)), abs=1e-9)
    plates = replace(lens, curvature=0 * lens.curvature, alpha=0 * lens.alpha)  # designs with a grade may start there
    assert focus.peak(plates, view).isfinite()


def one(lens: Lens, name: str, tolerances: Grade) -> Lens:
    """The lens with one error as large as its tolerance."""
    all_errors = errors(lens, tolerances)
    fractions = f64([float(error.name == name) for error in all_errors])
    assert fractions.sum() == 1, [error.name for error in all_errors]
    return with_errors(lens, all_errors, fractions, D_LINE)


def test_errors_have_the_size_and_place_that_they_say():
    lens, _ = doublet()
    every = Grade.model_validate("precision_moulding")
    assert one(lens, "radius 2", every).curvature[2] == pytest.approx(-0.2 / 1.005)
    assert one(lens, "thickness 3", every).thickness[3] == pytest.approx(0.515)
    assert one(lens, "air space 2", every).thickness[2] == pytest.approx(0.315)
    pose = one(lens, "surface decentre 2 y", every).pose
    assert pose.position[2].tolist() == pytest.approx([0.0, 0.015, 0.0]) and not pose.position[[0, 1, 3, 4]].any()
    pose = one(lens, "element decentre 3 x", every).pose
    assert pose.position[[3, 4], 0].tolist() == pytest.approx([0.0125] * 2) and not pose.position[:3].any()
    tilted = one(lens, "element tilt 3 x", every).pose.position
    expected = lens.with_element_moved(3, 4, f64([0.0, 0.0]), f64([0.003, 0.0])).pose.position
    torch.testing.assert_close(tilted, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("order", [4, 6])
def test_form_errors_have_their_height(order):
    """From valley to peak over the clear aperture, the vertex where it was."""
    lens, _ = doublet()
    fringes = grade(irregularity_fringes=6.0)
    changed = one(lens, f"form 3 {order}", fringes)
    r = torch.linspace(0, 1.4, 2001, dtype=torch.float64)
    sag = changed.surfaces[3].sag(r, 0 * r) - lens.surfaces[3].sag(r, 0 * r)
    height = 6 * 0.3164e-3 * 2.8 / 25 / math.sqrt(2)
    assert float(sag.max() - sag.min()) == pytest.approx(height, rel=1e-3) and sag[0] == 0
    assert torch.equal(changed.alpha[[0, 1, 2, 4]], torch.zeros(4, 3, dtype=torch.float64))


def test_a_form_error_needs_an_aperture():
    lens = replace(doublet()[0], semi_diameter=f64([0.5, *[torch.inf] * 4]))
    with pytest.raises(ValueError, match="surface 1 has no clear aperture"):
        errors(lens, grade(irregularity_fringes=1.0))


def test_index_and_dispersion_of_a_melt():
    """The shift holds at every wavelength; a spread of 1 % makes the Abbe number 1 % smaller; air stays as it is."""
    lens, _ = doublet()
    lines = (0.6562725, D_LINE, 0.4861327)
    before = lens.refractive_indices(lines)
    shifted = one(lens, "index 1", grade(index=0.001)).refractive_indices(lines)
    torch.testing.assert_close(shifted[2] - before[2], f64([0.001] * 3), rtol=0, atol=1e-15)
    assert torch.equal(shifted[[0, 1, 3, 4, 5]], before[[0, 1, 3, 4, 5]])
    spread = one(lens, "dispersion 3", grade(dispersion_percent=1.0)).refractive_indices(lines)
    assert spread[4, 1] == before[4, 1]
    assert float((spread[4, 2] - spread[4, 0]) / (before[4, 2] - before[4, 0])) == pytest.approx(1.01, rel=1e-9)


def test_rays_carry_derivatives_by_a_melt():
    lens, view = doublet()
    nought, pupil = torch.zeros(5, dtype=torch.float64), sobol_disc(16, seed=0)

    def spot(shift: torch.Tensor) -> torch.Tensor:
        rays = trace_fields(replace(lens, melt=Melt(shift, nought, D_LINE)), view, pupil)
        return rays.x.square().sum()

    slope = torch.func.grad(spot)(nought)[1]
    step = f64([0.0, 1e-5, 0.0, 0.0, 0.0])
    assert float(slope) == pytest.approx(float(spot(step) - spot(-step)) / 2e-5, rel=1e-5)
    assert lens.detached().melt is None and replace(lens, melt=Melt(nought, nought, D_LINE)).detached().melt is not None


# ---- focus


def test_through_focus_is_the_mtf_of_each_plane():
    lens, view = doublet()
    contrast = focus.through_focus(lens, view, -0.02, 0.01, 4)
    for shift, value in zip((-0.02, -0.01, 0.0, 0.01), contrast.tolist(), strict=True):
        rays = trace_fields(move_image_plane(lens, shift), view, sobol_disc(256, seed=0))
        expected = torch.stack(geometric_mtf(rays, view.directions, [1e3 / 2.0 / 8])).mean()
        assert value == pytest.approx(float(expected), abs=1e-9)


@pytest.mark.parametrize("shift", [-0.02, 0.007])
def test_a_shifted_sensor_is_focused_back(shift):
    lens, view = doublet()
    by = focus.peak(move_image_plane(lens, shift), view) - focus.peak(lens, view)
    assert by == pytest.approx(-shift, abs=5e-4)


@pytest.mark.parametrize("shift", [-0.4, 0.15])
def test_a_long_lens_is_focused_within_a_tenth_of_its_depth(shift):
    """Depth is F-number / frequency, here 0.09 mm, and not a part of the focal length of 50 mm."""
    lens = cooke_triplet()
    view = View(f64([[0.0, 0.0], [0.0, 1.0]]), 50.0, (0.6563, D_LINE, 0.4861), 1.8, 51)
    lens = refocus(lens, view, "spot")
    by = focus.peak(move_image_plane(lens, shift), view) - focus.peak(lens, view)
    assert by == pytest.approx(-shift, abs=0.002)


@pytest.mark.parametrize("shift", [1.5, -4.0])
def test_the_peak_is_searched_until_it_is_inside_the_range(shift):
    """At first the planes reach 2 % of the focal length, 1 mm; coarse errors defocus a lens by more."""
    lens, view = cooke_triplet(), View(f64([[0.0, 0.0], [0.0, 9.0]]), 50.0, (D_LINE,), 20.0, 51)
    moved = focus.peak(move_image_plane(lens, shift), view)
    assert float(moved - focus.peak(lens, view)) == pytest.approx(-shift, abs=0.02)


def test_a_field_without_light_has_no_displacements():
    """An aperture that lets only the axis through: infinite, by derivative and traced."""
    lens, view = doublet()
    view = replace(view, fields=f64([[0.0, 0.0], [3.0, 0.0]]))
    last = torch.arange(len(lens.media)) == len(lens.media) - 1
    dark = replace(lens, semi_diameter=torch.where(last, 0.3, lens.semi_diameter))
    assert not trace_fields(dark, view, sobol_disc(64, seed=0)).valid.any(-1).any(-1).all()
    all_errors = errors(dark, grade(element_decentre_um=20.0))
    assert torch.isinf(displacements(dark, view, all_errors, 64)).all()
    assert torch.isinf(traced_displacements(dark, view, all_errors, 64)).all()


def test_a_decentre_of_either_sign_is_focused_alike():
    """A decentre tilts the image surface; fields of one quadrant alone would show it as a shift."""
    lens, view = doublet()
    lenses = MonteCarlo(lens, view, errors(lens, grade(element_decentre_um=20.0)))
    (left, left_by), (right, right_by) = (lenses.build(s * f64([1, 0, 0, 0])) for s in (1, -1))
    assert float(left_by) == pytest.approx(float(right_by), abs=5e-4)
    for built, by in ((left, left_by), (right, right_by)):
        assert float(built.thickness[4] - lens.thickness[4]) == pytest.approx(float(by), abs=1e-12)


def test_fields_in_all_quadrants():
    fields = View(f64([[0, 0], [1, 0], [0, 2], [1, 2]]), 4.0, (D_LINE,), 1.8, 3).in_all_quadrants().fields
    assert len(fields) == 9 and {(x, y) for x in (-1, 0, 1) for y in (-2, 0, 2)} == {*map(tuple, fields.tolist())}


# ---- sensitivities


def least_displacement_um(lens: Lens, changed: Lens, view: View) -> float:
    """Least displacement of the core of `lens` in `changed`, in the best image plane, by a search over planes."""
    pupil = sobol_disc(128, seed=0)
    nominal = trace_fields(lens, view, pupil)
    chief = trace_fields(lens, view.in_reference(), torch.zeros(1, 2, dtype=torch.float64))
    squared = (nominal.x - chief.x) ** 2 + (nominal.y - chief.y) ** 2
    core = squared <= squared.flatten(1).quantile(0.5, dim=1, interpolation="lower")[:, None, None]
    best, at, width = math.inf, 0.0, 200.0
    for _ in range(6):  # finer each time
        for shift in torch.linspace(at - width, at + width, 21).tolist():
            rays = trace_fields(move_image_plane(changed, shift / 1e3), view, pupil)
            fields = []
            for k in range(len(view.fields)):
                offsets = torch.stack([rays.x - nominal.x, rays.y - nominal.y])[:, k, core[k]]
                fields.append((offsets - offsets.mean(1, keepdim=True)).square().sum(0).mean())
            best, at = min((best, at), (1e3 * float(sum(fields) / len(fields)) ** 0.5, shift))
        width /= 10
    return best


@pytest.mark.parametrize("name", ["radius 2", "index 3", "element tilt 1 x"])
def test_displacements_are_those_of_lenses_that_are_off_and_refocused(name):
    """By derivative, and traced, against a search for the best image plane."""
    lens, view = doublet()
    every = Grade.model_validate("precision_moulding")
    all_errors = errors(lens, every)
    at = [error.name for error in all_errors].index(name)
    expected = least_displacement_um(lens, one(lens, name, every), view.in_all_quadrants())
    assert expected > 0.001
    assert float(displacements(lens, view, all_errors, 128)[at]) == pytest.approx(expected, rel=0.03)
    assert float(traced_displacements(lens, view, all_errors, 128)[at]) == pytest.approx(expected, rel=0.03)


def test_built_lenses_follow_linear_theory():
    """Small errors: the mean square displacement of core rays is the sum over errors, times the variance."""
    lens, view = doublet()
    small = Grade(**{kind: value / 20 for kind, value in GRADES["precision_moulding"].items()})
    all_errors = errors(lens, small)
    expected = DEVIATION**2 * float(displacements(lens, view, all_errors, 128).square().sum())
    wide, pupil = view.in_all_quadrants(), sobol_disc(128, seed=0)
    nominal, centre = trace_fields(lens, wide, pupil), chief_points(lens, wide)
    core = distances(nominal, centre) <= encircled_energy_radius(nominal, centre, 0.5)[:, None, None]
    squares = []
    for fractions in draw(all_errors, 100, 1):
        rays = trace_fields(with_errors(lens, all_errors, fractions, D_LINE), wide, pupil)
        d = torch.stack([rays.x - nominal.x, rays.y - nominal.y])
        q = torch.stack([rays.l / rays.n, rays.m / rays.n])
        d, q = (torch.stack([v[:, k, core[k]] for k in range(len(core))], 1) for v in (d, q))
        d, q = (v - v.mean(-1, keepdim=True) for v in (d, q))
        t = -(d * q).sum() / (q * q).sum()
        squares.append(1e6 * float((d + t * q).square().sum(0).mean()))
    error = torch.tensor(squares).std() / 10  # of the mean of 100
    assert sum(squares) / 100 == pytest.approx(expected, abs=4 * float(error))
    assert float(error) < 0.12 * expected


# ---- settings


def test_grades_have_names():
    for name in GRADES:
        assert Grade.model_validate(name).name == name
        assert Grade.model_validate(name).thickness_um == GRADES[name]["thickness_um"]
