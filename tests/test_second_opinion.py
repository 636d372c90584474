"""Image positions of whole lenses against Optiland, by its public calls.

Optiland launches the rays itself, from field angles and the aperture, so that the bundles are compared as well as the
tracing. Refractive indices are ours in both.
"""

import math
import os
from dataclasses import replace

import numpy
import pytest
import torch
from examples import WAVELENGTHS, cooke_triplet, f64, materials, random_lens

from tasklens.design import least_squares
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.study.design_settings import LeastSquaresSettings
from tasklens.study.settings import Constraints, Spec

os.environ.setdefault("MPLBACKEND", "Agg")  # it draws; nothing is drawn here
import optiland.backend
from optiland.materials import IdealMaterial
from optiland.optic import Optic

RAYS = 64


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    optiland.backend.set_backend("numpy")


def in_optiland(lens: Lens, looks: View, wavelength: float) -> tuple[Optic, numpy.ndarray]:
    """The lens at one wavelength, and its fields as Optiland normalises them."""
    optic = Optic()
    optic.surfaces.add(index=0, radius=numpy.inf, thickness=numpy.inf)
    indices = lens.refractive_indices((wavelength,))[1:, 0].tolist()
    curvature, conic, thickness = lens.curvature.tolist(), lens.conic.tolist(), lens.thickness.tolist()
    for i, index in enumerate(indices):
        shape = {"radius": 1 / curvature[i] if curvature[i] else numpy.inf, "conic": conic[i]}
        if lens.alpha[i].any():  # its default tolerance of 1e-6 mm is coarser than the comparison
            shape |= {"surface_type": "even_asphere", "coefficients": lens.alpha[i].tolist(), "tol": 1e-14}
        medium = {"material": IdealMaterial(index), "thickness": thickness[i], "is_stop": i == lens.stop}
        optic.surfaces.add(index=i + 1, **shape, **medium)
    optic.surfaces.add(index=len(indices) + 1)
    # Both fill the entrance pupil of the middle wavelength.
    radius = float(paraxial(lens, looks.wavelengths[len(looks.wavelengths) // 2]).entrance_pupil_radius)
    optic.set_aperture("EPD", 2 * radius)
    optic.fields.set_type("angle")
    degrees = numpy.degrees(numpy.arctan(looks.tangents.numpy()))
    for x, y in degrees:
        optic.fields.add(x=x, y=y)
    optic.wavelengths.add(value=wavelength, is_primary=True)
    return optic, degrees / numpy.hypot(*degrees.T).max()


def assert_same_image_points(lens: Lens, looks: View) -> None:
    """Every ray that comes through, at every field and wavelength, within 1e-9 mm."""
    pupil = sobol_disc(RAYS, seed=0)
    ours = trace_fields(lens, looks, pupil)
    assert ours.valid.double().mean() > 0.9
    for w, wavelength in enumerate(looks.wavelengths):
        optic, fields = in_optiland(lens, looks, wavelength)
        for f, (hx, hy) in enumerate(fields):
            px, py = pupil.T.numpy()
            theirs = optic.trace_generic(numpy.full(RAYS, hx), numpy.full(RAYS, hy), px, py, wavelength)
            through = ours.valid[f, w]
            for a, b in ((ours.x, theirs.x), (ours.y, theirs.y)):
                torch.testing.assert_close(a[f, w][through], f64(b)[through], rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_random_aspheres(seed):
    """Conics and aspheres up to alpha_10 of either sign, with an r^2 term, at fields to both sides of both axes."""
    lens = random_lens(seed)
    lens = replace(lens, semi_diameter=f64([0.3, *[torch.inf] * 4]))
    fields = f64([[0, 0], [0.2, 0], [-0.1, 0.2], [0.15, 0.25], [0.2, -0.2]])
    assert_same_image_points(lens, View(fields, 1.0, WAVELENGTHS, 1.8, 51))


def test_a_finished_design():
    """A doublet by least squares, up to the corner of the paper's field."""
    spec, limits = Spec(), Constraints()
    settings = LeastSquaresSettings(method="least_squares", starts=6, evaluations=100)
    start = flat(materials("COC", "OKP4"), spec, limits)
    lens, _ = least_squares.design(start, Problem(view_of_spec(spec), limits, 0), settings)
    assert lens.alpha.any()
    assert_same_image_points(lens, view_of_spec(spec))


@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0])
def test_rays_aimed_at_a_stop_inside(degrees):
    """The Cooke triplet at its middle wavelength: the same image points as with Optiland's ray aiming."""
    lens, tangent = cooke_triplet(), math.tan(math.radians(degrees))
    view = View(f64([[0, tangent], [0, math.tan(math.radians(20))]]), 1.0, WAVELENGTHS[1:2], 1.8, 51)
    pupil = sobol_disc(RAYS, seed=0)
    ours = trace_fields(lens, view, pupil)
    assert ours.valid.all()
    optic, fields = in_optiland(lens, view, WAVELENGTHS[1])
    # By the diameter of the stop: with that of the entrance pupil its aiming takes the stop of a real marginal ray.
    radius = float(lens.semi_diameter[lens.stop])
    optic.set_aperture("float_by_stop_size", 2 * radius)
    optic.surfaces[lens.stop + 1].set_semi_aperture(radius)
    optic.ray_tracer.set_aiming("iterative", max_iter=30, tol=1e-11)
    theirs = optic.trace_generic(*(numpy.full(RAYS, h) for h in fields[0]), *pupil.T.numpy(), WAVELENGTHS[1])
    for a, b in ((ours.x, theirs.x), (ours.y, theirs.y)):
        torch.testing.assert_close(a[0, 0], f64(b), rtol=0, atol=1e-11)
