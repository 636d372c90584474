"""A lens defined in Python, surface by surface."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from tasklens.materials.library import Library
from tasklens.materials.material import AIR, Material, model_glass
from tasklens.optics.io.prescription import ORDERS, Prescription, check_order
from tasklens.optics.lens import Lens
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import positive

_KEYS = ("radius", "curvature", "thickness", "material", "conic", "semi_diameter", "stop")


def prescription_of(surfaces: Sequence[Mapping[str, Any]], library: Library) -> Prescription:
    """Return the prescription of a lens from its surfaces.

    Args:
        surfaces: for each surface `radius` or `curvature`, `thickness` to the next one, `material` behind it (name,
            `Material`, or nd and Vd; air if absent), `conic`, coefficients `alpha_2`, `alpha_4` .. of r^2, r^4 ..
            [mm^(1 - 2j)], `semi_diameter` of its clear aperture; `stop` at one surface. Lengths in mm. The last
            thickness is 0 if absent.
        library: glasses by name.

    Raises:
        InputError: an unknown or missing key, a value that is not a number, or not exactly one stop; names the surface.
    """
    if not surfaces:
        raise InputError("surfaces: expected at least one")
    rows = [_row(surface, i, last=i == len(surfaces) - 1) for i, surface in enumerate(surfaces)]
    stops = [i for i, surface in enumerate(surfaces) if surface.get("stop")]
    if len(stops) != 1:
        raise InputError(f"a lens: expected `stop` at one surface, got {len(stops)}")
    terms = max(ORDERS.get(key, 0) for surface in surfaces for key in surface)

    def column(key: str) -> torch.Tensor:
        return torch.tensor([row[key] for row in rows], dtype=torch.float64)

    alpha = [[row.get(f"alpha_{2 * j}", 0.0) for j in range(1, terms + 1)] for row in rows]
    lens = Lens(
        curvature=column("curvature"),
        conic=column("conic"),
        alpha=torch.tensor(alpha, dtype=torch.float64).reshape(len(rows), terms),
        thickness=column("thickness"),
        semi_diameter=column("semi_diameter"),
        media=tuple(_medium(surface.get("material"), library) for surface in surfaces),
        stop=stops[0],
    )
    check_order(lens.media, lens.thickness.tolist(), "a lens", first=0)
    return Prescription(lens)


def _row(surface: Mapping[str, Any], index: int, last: bool) -> dict[str, Any]:
    """Return the numbers of a surface."""
    where = f"surface {index}"
    for key in surface:
        if key not in _KEYS and key not in ORDERS:
            raise InputError(f"{where}: unknown key {key!r}; expected {', '.join(_KEYS)}, alpha_2, alpha_4 ..")
    if ("radius" in surface) == ("curvature" in surface):
        raise InputError(f"{where}: expected either `radius` (inf for a plane) or `curvature`")
    if "thickness" not in surface and not last:
        raise InputError(f"{where}: expected `thickness`, the distance to the next surface [mm]")
    if surface.get("radius") == 0:
        raise InputError(f"{where}: radius: expected a number other than 0, such as inf for a plane")
    curvature = 1 / _real(surface, "radius", where) if "radius" in surface else _real(surface, "curvature", where)
    return {
        "curvature": curvature,
        "thickness": _real(surface, "thickness", where, 0.0),
        "conic": _real(surface, "conic", where, 0.0),
        **{key: _real(surface, key, where) for key in surface if key in ORDERS},
        "semi_diameter": _real(surface, "semi_diameter", where, math.inf),
    }


def _real(surface: Mapping[str, Any], key: str, where: str, default: float = 0.0) -> float:
    """Return the value of a key as a number; radii and clear apertures may be infinite."""
    value = surface.get(key, default)
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if key == "semi_diameter" and number < 0:
        raise InputError(f"{where}: {key}: expected a radius that is not negative, got {value!r}")
    if math.isnan(number) or (math.isinf(number) and key not in ("radius", "semi_diameter")):
        raise InputError(f"{where}: {key}: expected a number, got {value!r}")
    return number


def _medium(material: Material | str | Sequence[float] | None, library: Library) -> Material:
    if material is None or material == AIR.name:
        return AIR
    if isinstance(material, tuple | list) and len(material) == 2:
        nd, vd = (positive(value, "material") for value in material)
        return model_glass(nd, vd, 0.0)
    if not isinstance(material, str | Material):
        raise InputError(f"material: expected the name of a glass, nd and Vd, or a material, got {material!r}")
    return library.glass(material) if isinstance(material, str) else material
