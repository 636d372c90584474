"""Lenses of the reference data as they are in their JSON files."""

import json
import math
from pathlib import Path

import torch
from examples import WAVELENGTHS, f64
from reference_files import reference_files

from tasklens.materials.material import AIR, C_LINE, D_LINE, F_LINE, Material
from tasklens.optics.analysis.aiming import stop_is_inside
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

LINES = {"F": F_LINE, "d": D_LINE, "C": C_LINE}
LENS_FILES = reference_files("lenses/*/*.json")


def with_indices(indices: dict | None, name: str = "reference") -> Material:
    """A material with the given indices at the F, d and C lines."""
    if indices is None:
        return AIR
    powers = f64([[1, w**2, w**-2] for w in LINES.values()])
    squares = f64([indices[line] ** 2 for line in LINES])
    coefficients = torch.linalg.solve(powers, squares).tolist()
    return Material(name, "schott", (*coefficients, 0.0, 0.0, 0.0), (0.4, 0.8))


def reference_lens(path: Path) -> Lens:
    """The lens of a file without clear apertures, with the stop of its F-number."""
    content = json.loads(path.read_text())
    surfaces = content["surfaces"][:-1]  # without the image plane
    alpha = torch.zeros(len(surfaces), 10, dtype=torch.float64)
    for i, surface in enumerate(surfaces):
        for power, value in surface["even_asphere"].items():
            alpha[i, int(power) // 2 - 1] = value
    (stop,) = (i for i, surface in enumerate(surfaces) if surface["stop"])
    lens = Lens(
        f64([surface["c"] for surface in surfaces]),
        f64([surface["k"] for surface in surfaces]),
        alpha,
        f64([surface["thickness_after"] for surface in surfaces]),
        f64([math.inf for _ in surfaces]),
        tuple(with_indices(surface["n"]) for surface in surfaces),
        stop,
    )
    radius = stop_radius(lens, ("entrance_pupil_diameter_mm", content["epd"]), D_LINE)
    lens.semi_diameter[stop] = radius
    return lens


class Tabulated(Lens):
    """A lens whose indices come from the reference file, column by wavelength."""

    def refractive_indices(self, wavelengths):
        return torch.tensor([[1.0] * 3, *self.table], dtype=self.dtype)[:, [WAVELENGTHS.index(w) for w in wavelengths]]


def tabulated_lens(entry: dict, dtype=torch.float64) -> Lens:
    """The lens of an entry of rays.json or tilted.json, without clear apertures."""
    surfaces = entry["surfaces"]
    orders = max(len(s["even_asphere"]) for s in surfaces)
    alpha = [s["even_asphere"] + [0.0] * (orders - len(s["even_asphere"])) for s in surfaces]
    column = lambda key: torch.tensor([s[key] for s in surfaces], dtype=dtype)  # noqa: E731
    lens = Tabulated(
        column("curvature"),
        column("conic"),
        torch.tensor(alpha, dtype=dtype).reshape(len(surfaces), orders),
        column("thickness"),
        torch.full((len(surfaces),), torch.inf, dtype=dtype),
        (AIR,) * len(surfaces),
        entry["stop_index"],
    )
    object.__setattr__(lens, "table", [s["n_after"] for s in surfaces])
    return lens


def reference_view(path: Path, fractions: tuple[float, ...]) -> View:
    """Fields of a file along +y as fractions of its largest angle, in its three colours."""
    content = json.loads(path.read_text())
    angles = torch.deg2rad(content["half_field_deg"] * f64(fractions))
    fields = torch.stack([torch.zeros_like(angles), angles.tan()], -1)
    return View(fields, 1.0, tuple(LINES.values()), 1.8, 31)


INNER_STOPS = [path for path in LENS_FILES if stop_is_inside(reference_lens(path))]
