"""Lenses of the reference data, also in Optiland, their fields, and words of the numbers that are compared."""

import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # readers of these files, and lenses in Optiland
from reference_lenses import reference_lens

from tasklens.materials.material import D_LINE
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

FRACTIONS = (0.0, 0.5, 0.7, 1.0)  # of the tangent of the largest field angle
SPOT_UM = 0.01  # tolerance of a spot radius
GRID = 33  # pupil points across, as in the reference spots
FINE = 101  # pupil points across, for CODE V's spots and for captures


@dataclass(frozen=True)
class Case:
    """A lens of the reference data at the d line, without clear apertures, and its numbers in the file.

    Attributes:
        path: its JSON file.
        content: content of that file.
        lens: the lens.
        view: the fields `FRACTIONS`, along +y.
        optiland: our lens in Optiland, and its fields; None without it.
    """

    path: Path
    content: dict
    lens: Lens
    view: View
    optiland: tuple | None

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.stem


def read(path: Path, peer: ModuleType | None) -> Case:
    """Read a lens."""
    content = json.loads(path.read_text())
    lens = reference_lens(path)
    largest = math.tan(math.radians(content["half_field_deg"]))
    view = view_along_y(lens, [fraction * largest for fraction in FRACTIONS], (D_LINE,))
    return Case(path, content, lens, view, peer and peer.in_optiland(lens, view))


def view_along_y(lens: Lens, tangents: Iterable[float], wavelengths: tuple[float, ...]) -> View:
    """View of fields along +y with direction tangents, in relation to the focal length of the lens."""
    efl = float(paraxial(lens, wavelengths[len(wavelengths) // 2]).efl)
    fields = torch.tensor([[0.0, efl * tangent] for tangent in tangents], dtype=torch.float64)
    return View(fields, efl, wavelengths, 1.8, 51)


def square_grid(points: int) -> Tensor:
    """Points of a square grid inside the unit disc, `points` across."""
    line = torch.linspace(-1, 1, points, dtype=torch.float64)
    grid = torch.cartesian_prod(line, line)
    return grid[grid.norm(dim=-1) <= 1 + 1e-9]


def worst(ours: Tensor, others: Tensor) -> float:
    """Return the largest difference where both are finite, or NaN if there is none."""
    differences = (ours - others).abs()
    differences = differences[differences.isfinite()]
    return float(differences.max()) if differences.numel() else math.nan


def words(values: Tensor | None, digits: int) -> str:
    """Numbers of the fields in one cell."""
    if values is None:
        return ""
    return " / ".join(f"{v:.{digits}f}" if math.isfinite(v) else "–" for v in values.flatten().tolist())


def difference(value: float, tolerance: float) -> str:
    """A difference, with a star beyond the tolerance."""
    return "" if math.isnan(value) else f"{value:.1e}{' *' if value > tolerance else ''}"
