"""The page of a lens: shapes of its surfaces, what moulding errors do, and its manufacturability."""

import math
from dataclasses import replace

import pytest
import torch
from examples import f64, make_lens, materials

from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.shapes import shapes
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.analysis.tolerances import RADIUS, THICKNESS, displacements
from tasklens.optics.view import View
from tasklens.report import manufacturability

COC, OKP4, AIR = materials("COC", "OKP4", "air")


def asphere(curvature: float, alpha_4: float, semi_diameter: float = 1.0):
    """One element behind a stop; its front is the asphere, its back plane."""
    alpha = f64([[0.0, 0.0], [0.0, alpha_4], [0.0, 0.0]])
    apertures = [0.5, semi_diameter, semi_diameter]
    return make_lens([0.0, curvature, 0.0], [0.1, 0.5, 3.0], (AIR, COC, AIR), alpha=alpha, semi_diameter=apertures)


def test_shape_of_a_sphere():
    """sin(steepest) = c R; no departure from itself, no inflection; a plane has nothing."""
    sphere, plane = shapes(asphere(0.4, 0.0))
    assert (sphere.surface, plane.surface) == (1, 2) and sphere.semi_diameter_mm == 1.0
    assert sphere.steepest_deg == pytest.approx(math.degrees(math.asin(0.4)), abs=1e-9)
    assert sphere.departure_um == pytest.approx(0.0, abs=1e-9) and sphere.inflections == 0
    assert plane.steepest_deg == plane.departure_um == plane.inflections == 0


def test_shape_of_an_asphere():
    """z = c r^2 / 2 + a r^4 with small c bends back where c + 12 a r^2 = 0; the departure is largest half-way in r^2.

    Against the parabola through the rim: a (r^4 - R^2 r^2), at most a R^4 / 4; sphere and parabola differ by c^3.
    """
    shape = shapes(asphere(0.012, -0.004))[0]
    assert shape.inflections == 1
    assert shape.departure_um == pytest.approx(1e3 * 0.004 / 4, abs=2e-3)
    assert shape.steepest_deg == pytest.approx(math.degrees(math.atan(0.016 - 0.012)), abs=2e-4)
    assert shapes(asphere(0.012, 0.004))[0].inflections == 0


def doublet():
    """Two elements that form an image, and a view of its axis and of 5 degrees."""
    lens = make_lens(
        [0.0, 0.25, -0.2, -0.15, 0.1],
        [0.2, 0.6, 0.3, 0.5, 4.0],
        (AIR, COC, AIR, OKP4, AIR),
        semi_diameter=[0.5, *[torch.inf] * 4],
    )
    return lens, View(f64([[0.0, 0.0], [0.0, 0.4]]), 4.6, (0.6563, 0.5893, 0.4861), 2.0, 31)


def least_displacement_um(lens, changed, view) -> float:
    """Of the core of a lens in the best image plane of a changed one, by search over planes, with other code."""
    pupil = sobol_disc(256, seed=0)
    nominal = trace_fields(lens, view, pupil)
    chief = trace_fields(lens, view.in_reference(), torch.zeros(1, 2, dtype=torch.float64))
    squared = (nominal.x - chief.x) ** 2 + (nominal.y - chief.y) ** 2
    core = squared <= squared.flatten(1).quantile(0.5, dim=1, interpolation="lower")[:, None, None]
    best, focus, width = math.inf, 0.0, 200.0
    for _ in range(6):  # finer each time
        for shift in torch.linspace(focus - width, focus + width, 41).tolist():
            rays = trace_fields(
                replace(changed, thickness=changed.thickness + f64([0.0] * 4 + [shift / 1e3])), view, pupil
            )
            fields = []
            for k in range(len(view.fields)):
                moved = torch.stack([rays.x - nominal.x, rays.y - nominal.y])[:, k, core[k]]
                fields.append((moved - moved.mean(1, keepdim=True)).square().sum(0).mean())
            best, focus = min((best, focus), (1e3 * float(sum(fields) / len(fields)) ** 0.5, shift))
        width /= 10
    return best


def test_errors_are_those_of_lenses_that_are_off_and_refocused():
    """A radius and a thickness, each against a search for the best image plane."""
    lens, view = doublet()
    errors = displacements(lens, view, 256)
    assert list(errors) == [*(f"radius {i}" for i in (1, 2, 3, 4)), *(f"thickness {i}" for i in (1, 2, 3))]

    def expected(name: str, surface: int, error: float) -> float:
        found = []
        for by in (error, -error):
            values = getattr(lens, name).clone()
            values[surface] += by
            found.append(least_displacement_um(lens, replace(lens, **{name: values}), view) ** 2)
        return (sum(found) / 2) ** 0.5

    assert errors["radius 2"] == pytest.approx(expected("curvature", 2, -0.2 * RADIUS), rel=0.01)
    assert errors["thickness 2"] == pytest.approx(expected("thickness", 2, THICKNESS), rel=0.01)
    assert min(errors["radius 2"], errors["thickness 2"]) > 0.005


def test_page_says_whether_it_can_be_made():
    """Limits first; then whether moulding errors move the core by less than a pixel; the tables hold the numbers."""
    kept, violated = {"max_slope": 0.01, "min_air_gap": 0.02}, {"max_slope": -0.03, "min_air_gap": 0.02}
    calm, lively = {"radius 1": 0.3, "thickness 1": 0.4}, {"radius 1": 3.0, "thickness 1": 4.0}
    surfaces = shapes(asphere(0.4, 0.0))
    page = manufacturability.markdown(kept, surfaces, calm, 1.8)
    assert page.startswith("## Manufacturability\n") and "Within precision moulding: all limits are kept" in page
    assert "move by 0.5 um (RMS)" in page and "thickness 1 (0.4 um)" in page
    assert "0.0200 mm" in page and "23.6" in page
    assert "Needs tighter tolerances" in manufacturability.markdown(kept, surfaces, lively, 1.8)
    page = manufacturability.markdown(violated, surfaces, calm, 1.8)
    assert "Not manufacturable: it violates max slope by 0.03." in page


@pytest.mark.parametrize("moved_um, words", [(1.8, "Within"), (1.81, "Needs tighter"), (20.0, "by 20.0 um")])
def test_a_lens_is_robust_up_to_a_pixel(moved_um, words):
    assert words in manufacturability.verdict({"max_slope": 0.0}, moved_um, 1.8)


def test_a_margin_that_is_no_number_is_violated():
    assert "Not manufacturable" in manufacturability.verdict({"max_slope": math.nan}, 12.0, 12.0)
