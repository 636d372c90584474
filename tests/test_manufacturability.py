"""The page of a lens: shapes of its surfaces, and its manufacturability."""

import math

import pytest
from examples import f64, make_lens, materials

from tasklens.optics.analysis.shapes import shapes
from tasklens.show import certificate

COC, AIR = materials("COC", "air")


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


def test_page_says_whether_it_can_be_made():
    """Limits first; then whether errors move the core by less than a pixel: 0.5 um at the tolerance, 0.2 on average."""
    margins, violated = {"max_slope": 0.01, "min_air_gap": 0.02}, {"max_slope": -0.03, "min_air_gap": 0.02}
    calm, lively = {"radius 1": 0.3, "thickness 1": 0.4}, {"radius 1": 3.0, "thickness 1": 4.0}
    surfaces = shapes(asphere(0.4, 0.0))
    page = certificate.manufacturability(margins, surfaces, calm, "precision_moulding", 1.8)
    assert page.startswith("## Manufacturability\n") and "Within precision moulding. All limits are kept" in page
    assert "move them by 0.2 um (RMS over many lenses" in page and "thickness 1 (0.4 um)" in page
    assert "23.6" in page
    page = certificate.manufacturability(margins, surfaces, lively, "precision_moulding", 1.8)
    assert "Needs tighter tolerances" in page
    page = certificate.manufacturability(violated, surfaces, calm, "precision_moulding", 1.8)
    assert "Not manufacturable: it violates max slope by 0.03." in page


@pytest.mark.parametrize(
    "margin, moved_um, words",
    [(0.0, 1.8, "Within"), (0.0, 1.81, "Needs tighter"), (0.0, 20.0, "20.0 um RMS"), (math.nan, 0.0, "Not manufact")],
)
def test_a_lens_is_robust_up_to_a_pixel(margin, moved_um, words):
    """A margin that is no number is violated."""
    assert words in certificate.limits_verdict({"max_slope": margin}, moved_um, "precision moulding", 1.8)
