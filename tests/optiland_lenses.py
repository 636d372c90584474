"""Our lenses in Optiland, another ray tracer, for tests that compare with it through its public interface."""

import os

import numpy
from torch import Tensor

from tasklens.materials.material import Material
from tasklens.optics.analysis.aiming import stop_is_inside
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

os.environ.setdefault("MPLBACKEND", "Agg")  # Optiland imports matplotlib; the tests draw nothing
import optiland.backend
from optiland.distribution import BaseDistribution
from optiland.materials.base import BaseMaterial
from optiland.optic import Optic


class OurMaterial(BaseMaterial):
    """A medium of Optiland with the dispersion of ours."""

    def __init__(self, material: Material):
        super().__init__()
        self.material = material

    def _calculate_n(self, wavelength, **_):
        wavelength = numpy.asarray(wavelength, dtype=float)
        return numpy.vectorize(self.material.refractive_index)(wavelength)

    def _calculate_k(self, wavelength, **_):
        return numpy.zeros_like(numpy.asarray(wavelength, dtype=float))

    def to_dict(self):
        return super().to_dict() | {"name": self.material.name, "coefficients": self.material.coefficients}


class Points(BaseDistribution):
    """Given points (N, 2) of the pupil."""

    def __init__(self, pupil: Tensor):
        super().__init__()
        self.x, self.y = pupil.T.numpy()

    def generate_points(self, num_points: int):
        raise NotImplementedError


def in_optiland(lens: Lens, view: View) -> tuple[Optic, numpy.ndarray]:
    """The lens at all fields and wavelengths, without clear apertures; and the fields as Optiland normalises them."""
    optiland.backend.set_backend("numpy")
    optic = Optic()
    optic.surfaces.add(index=0, radius=numpy.inf, thickness=numpy.inf)
    curvature, conic, thickness = lens.curvature.tolist(), lens.conic.tolist(), lens.thickness.tolist()
    for i, material in enumerate(lens.media):
        shape = {"radius": 1 / curvature[i] if curvature[i] else numpy.inf, "conic": conic[i]}
        if lens.alpha[i].any():  # its default tolerance of 1e-6 mm is coarser than the comparison
            shape |= {"surface_type": "even_asphere", "coefficients": lens.alpha[i].tolist(), "tol": 1e-14}
        medium = {"material": OurMaterial(material), "thickness": thickness[i], "is_stop": i == lens.stop}
        optic.surfaces.add(index=i + 1, **shape, **medium)
    optic.surfaces.add(index=len(lens.media) + 1)
    if stop_is_inside(lens):
        # By the stop's diameter: from an entrance pupil's, Optiland takes the stop of a real marginal ray.
        radius = float(lens.semi_diameter[lens.stop])
        optic.set_aperture("float_by_stop_size", 2 * radius)
        optic.surfaces[lens.stop + 1].set_semi_aperture(radius)
        optic.ray_tracer.set_aiming("iterative", max_iter=30, tol=1e-11)
    else:
        optic.set_aperture("EPD", 2 * float(paraxial(lens, view.reference_um).entrance_pupil_radius))
    optic.fields.set_type("angle")
    degrees = numpy.degrees(numpy.arctan(view.tangents.numpy()))
    for x, y in degrees:
        optic.fields.add(x=x, y=y)
    for i, wavelength in enumerate(view.wavelengths_um):
        optic.wavelengths.add(value=wavelength, is_primary=i == len(view.wavelengths_um) // 2)
    return optic, degrees / numpy.hypot(*degrees.T).max()
