"""Image positions and wavefronts of whole lenses against Optiland, by its public calls.

Optiland launches the rays itself, from field angles and the aperture, so that the bundles are compared as well as the
tracing. Both use our refractive indices.
"""

from dataclasses import replace

import numpy
import pytest
import torch
from examples import HEADLINE, WAVELENGTHS, cooke_triplet, f64, random_lens
from reference_files import SHIPPED

import tasklens
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.analysis.wavefront import path_differences
from tasklens.optics.io import zemax
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

OPTILAND = pytest.importorskip("optiland_lenses", reason="Optiland is not installed")
RAYS = 64
DOUBLET = HEADLINE / "doublet-imaging2.yaml"


def assert_same_image_points(lens: Lens, view: View, atol: float = 1e-9) -> None:
    """Every ray that comes through, at every field and wavelength."""
    pupil = sobol_disc(RAYS, seed=0)
    ours = trace_fields(lens, view, pupil)
    assert ours.valid.double().mean() > 0.9
    optic, fields = OPTILAND.in_optiland(lens, view)
    for w, wavelength in enumerate(view.wavelengths_um):
        for f, (hx, hy) in enumerate(fields):
            px, py = pupil.T.numpy()
            theirs = optic.trace_generic(numpy.full(RAYS, hx), numpy.full(RAYS, hy), px, py, wavelength)
            through = ours.valid[f, w]
            for a, b in ((ours.x, theirs.x), (ours.y, theirs.y)):
                torch.testing.assert_close(a[f, w][through], f64(b)[through], rtol=0, atol=atol)


def test_random_aspheres():
    """Conics and aspheres up to alpha_10 of either sign, with an r^2 term, at fields to both sides of both axes."""
    lens = replace(random_lens(1), semi_diameter=f64([0.3, *[torch.inf] * 4]))
    fields = f64([[0, 0], [0.2, 0], [-0.1, 0.2], [0.2, -0.2]])
    assert_same_image_points(lens, View(fields, 1.0, WAVELENGTHS, 1.8, 51))


def test_a_finished_design():
    """A published doublet by least squares, up to the corner of the paper's field."""
    lens, view = tasklens.load_lens(DOUBLET)
    assert lens.alpha.any()
    assert_same_image_points(lens, view)


# ---- wavefronts


def assert_same_wavefronts(lens: Lens, view: View) -> None:
    """Path differences within 1e-8 waves.

    Optiland centres the sphere where the chief ray of each wavelength meets the image plane, as we do, and takes the
    exit pupil at the primary wavelength. Its sphere is in front of the image even if the exit pupil is not: both
    spheres agree if it is. Its rays are not vignetted.
    """
    from optiland.wavefront import Wavefront

    pupil = sobol_disc(RAYS, seed=0)
    ours = path_differences(lens, view, pupil)
    assert ours.isfinite().double().mean() > 0.8
    optic, fields = OPTILAND.in_optiland(lens, view)
    for f, field in enumerate(map(tuple, fields)):
        reference = Wavefront(optic, [field], list(view.wavelengths_um), distribution=OPTILAND.Points(pupil))
        for w, theirs in enumerate(reference.data.values()):
            through = ours[f, w].isfinite()
            torch.testing.assert_close(ours[f, w][through], f64(theirs.opd)[through], rtol=0, atol=1e-8)


PUBLISHED = (
    "cellphone/source/US-12078784-B2-e6",
    "cellphone/source/US20210165194A1",
    "classical/source/US00583336-2-scaled",
)


@pytest.mark.parametrize("name", PUBLISHED)
def test_wavefronts_of_published_lenses(name):
    """Phone lenses with the stop in front and inside, aspheres to r^20, five colours; the original double Gauss."""
    path = SHIPPED / "lenses" / f"{name}.zmx"
    imported = zemax.read(path, list((SHIPPED / "glass").glob("*.AGF")))
    efl = float(paraxial(imported.lens, imported.wavelengths_um[imported.primary]).efl)
    fields = efl * f64([[0.0, 0.0], [0.3, -0.2]])
    assert_same_wavefronts(imported.lens, View(fields, efl, imported.wavelengths_um, 1.8, 51))


def test_wavefronts_of_a_triplet():
    fields = f64([[0.0, 9.0], [10.0, 6.0], [0.0, -14.0]])
    assert_same_wavefronts(cooke_triplet(), View(fields, 50.0, WAVELENGTHS, 1.8, 51))


def test_wavefronts_of_random_aspheres():
    """Dozens of waves, behind a stop. Without r^2 terms, which Optiland's paraxial rays ignore."""
    lens = random_lens(1)
    alpha = lens.alpha * f64([0.0, 1.0, 1.0, 1.0, 1.0])
    view = View(f64([[0, 0], [-0.1, 0.2], [0.2, -0.2]]), 1.0, WAVELENGTHS, 1.8, 51)
    assert_same_wavefronts(replace(lens, alpha=alpha, semi_diameter=f64([0.3, *[torch.inf] * 4])), view)
