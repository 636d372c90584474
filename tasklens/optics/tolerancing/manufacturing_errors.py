"""Manufacturing errors of a lens, and the lens with these errors.

An element is a body between air; a cemented group is one element. The first surface of an element is its seat: it moves
with the element, and the errors of the other surfaces are relative to it. The image plane and a stop in air do not
move. A plane stop inside a glass has no errors. Rays are aimed at the nominal stop.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.lens import Lens, Melt
from tasklens.settings.tolerance_settings import Grade

_FRINGE_MM = 0.6328e-3 / 2  # height of a fringe in reflection
_TEST_DIAMETER_MM = 25.0  # diameter over which fringes are counted
_QUANTILE = math.erf(math.sqrt(2))  # of a normal variable within two standard deviations
# Standard deviation of an error / its tolerance, 0.44: a normal variable of deviation 1/2, truncated at two deviations.
DEVIATION = 0.5 * math.sqrt(1 - 4 * math.exp(-2) / (math.sqrt(2 * math.pi) * _QUANTILE))

# Form errors that do not move the vertex, in rho = r / semi-diameter: Zernike's spherical aberrations of fourth and
# sixth order, coefficients of rho^2, rho^4, rho^6, divided by their range on the disc.
_FORMS = {4: (-6 / 1.5, 6 / 1.5, 0.0), 6: (12 / 2, -30 / 2, 20 / 2)}


@dataclass(frozen=True)
class Error:
    """One error of a lens.

    Attributes:
        kind: quantity in error; `Grade` has the tolerance of each kind.
        surface: index of the surface; for an element its first surface, for a medium the surface in front of it.
        part: x or y for decentres and tilts, the order for a form error; otherwise empty.
        tolerance: largest error, in `unit`.
        unit: unit of `tolerance`, for display.
        scale: one `unit` in units of the lens: fractions, mm, rad.
        radius: radius of the clear aperture over which a form error is specified [mm].
    """

    kind: str
    surface: int
    part: str
    tolerance: float
    unit: str
    scale: float
    radius: float = 1.0

    @property
    def name(self) -> str:
        """Name in tables, such as `surface decentre 3 x`."""
        return f"{self.kind.replace('_', ' ')} {self.surface} {self.part}".strip()


def elements(lens: Lens) -> list[tuple[int, int]]:
    """Return the first and the last surface of each element."""
    groups: list[tuple[int, int]] = []
    for i in lens.refracting_surfaces:
        before = lens.media[i - 1] if i else AIR
        if before == AIR:
            groups.append((i, i))
        else:
            groups[-1] = groups[-1][0], i
    return groups


def errors(lens: Lens, grade: Grade) -> list[Error]:
    """List the errors that a tolerance grade allows, without errors of zero tolerance."""
    result: list[Error] = []

    def add(kind: str, surface: int, tolerance: float, unit: str, scale: float, parts: Sequence[str] = ("",)) -> None:
        result.extend(Error(kind, surface, part, tolerance, unit, scale) for part in parts if tolerance > 0)

    for first, last in elements(lens):
        surfaces = [i for i in lens.refracting_surfaces if first <= i <= last]
        if first:
            add("air_space", first - 1, grade.air_space_um, "um", 1e-3)
        for i in surfaces:
            add("radius", i, grade.radius_percent, "%", 1e-2)  # of flat surfaces too: designs begin flat
            if grade.irregularity_fringes:
                radius = _radius(lens, i)
                form_um = 1e3 * grade.irregularity_fringes * _FRINGE_MM * 2 * radius / _TEST_DIAMETER_MM
                height_um = form_um / math.sqrt(len(_FORMS))
                result += [Error("form", i, str(order), height_um, "um", 1e-3, radius) for order in _FORMS]
        for i in surfaces[:-1]:
            add("thickness", i, grade.thickness_um, "um", 1e-3)
            add("index", i, grade.index, "", 1.0)
            add("dispersion", i, grade.dispersion_percent, "%", 1e-2)
        for i in surfaces[1:]:
            add("surface_decentre", i, grade.surface_decentre_um, "um", 1e-3, "xy")
            add("surface_tilt", i, grade.surface_tilt_mrad, "mrad", 1e-3, "xy")
        add("element_decentre", first, grade.element_decentre_um, "um", 1e-3, "xy")
        add("element_tilt", first, grade.element_tilt_mrad, "mrad", 1e-3, "xy")
    return result


def _radius(lens: Lens, surface: int) -> float:
    """Return the radius of the clear aperture [mm]; raises ValueError if there is none."""
    radius = float(lens.semi_diameter[surface])
    if not math.isfinite(radius):
        raise ValueError(f"surface {surface} has no clear aperture, which its form error needs")
    return radius


def draw(error_list: Sequence[Error], count: int, seed: int) -> Tensor:
    """Draw errors (count, P) as fractions of their tolerances: normal, standard deviation 1/2, truncated at 1."""
    uniform = torch.rand(count, len(error_list), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.erfinv((2 * uniform - 1) * _QUANTILE) / math.sqrt(2)


def with_errors(lens: Lens, error_list: Sequence[Error], fractions: Tensor, reference: float) -> Lens:
    """Return the lens with errors, differentiable in the lens and in the errors.

    Args:
        error_list: P errors of the lens.
        fractions: (P,) each error divided by its tolerance.
        reference: wavelength of index errors [um].
    """
    sizes = torch.tensor([error.tolerance * error.scale for error in error_list], dtype=lens.dtype)
    values = fractions.to(lens.dtype) * sizes

    def total(kind: str, part: str = "") -> Tensor:
        """Sum the errors of a kind for each surface, (S,)."""
        at = [k for k, error in enumerate(error_list) if (error.kind, error.part) == (kind, part)]
        where = torch.tensor([error_list[k].surface for k in at], dtype=torch.long)
        return torch.zeros(len(lens.media), dtype=lens.dtype).index_add(0, where, values[at])

    def pair(kind: str) -> Tensor:
        return torch.stack([total(kind, "x"), total(kind, "y")], -1)

    refracting = lens.refracting_surfaces  # a medium behind any other surface belongs to the same piece of glass
    piece = [max((k for k in refracting if k <= i), default=i) for i in range(len(lens.media))]
    forms = [(error, values[k]) for k, error in enumerate(error_list) if error.kind == "form"]
    lens_built = replace(
        lens,
        curvature=lens.curvature / (1 + total("radius")),
        alpha=_with_form(lens, forms),
        thickness=lens.thickness + total("thickness") + total("air_space"),
        melt=Melt(total("index")[piece], total("dispersion")[piece], reference),
    )
    decentre, tilt = pair("surface_decentre"), pair("surface_tilt")
    for i in sorted({error.surface for error in error_list if error.kind.startswith("surface")}):
        lens_built = lens_built.with_surface_moved(i, decentre[i], tilt[i])
    decentre, tilt = pair("element_decentre"), pair("element_tilt")
    first_surfaces = {error.surface for error in error_list if error.kind.startswith("element")}
    for first, last in (element for element in elements(lens) if element[0] in first_surfaces):
        lens_built = lens_built.with_element_moved(first, last, decentre[first], tilt[first])
    return lens_built


def _with_form(lens: Lens, forms: Sequence[tuple[Error, Tensor]]) -> Tensor:
    """Return the asphere coefficients (S, M) with form errors of the specified peak-to-valley heights [mm]."""
    if not forms:
        return lens.alpha
    powers = torch.arange(1, 4, dtype=lens.dtype)
    coefficients = torch.stack(
        [
            height * torch.tensor(_FORMS[int(error.part)], dtype=lens.dtype) / error.radius ** (2 * powers)
            for error, height in forms
        ]
    )
    where = torch.tensor([error.surface for error, _ in forms])
    form = torch.zeros(len(lens.media), 3, dtype=lens.dtype).index_add(0, where, coefficients)
    columns = max(3, lens.alpha.shape[1])
    alpha, form = (torch.nn.functional.pad(v, (0, columns - v.shape[1])) for v in (lens.alpha, form))
    return alpha + form
