"""Fields, wavelengths and pixels at which a lens is evaluated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.fields import CELLS
from tasklens.runtime.errors import InputError
from tasklens.settings.specification import Spec

_WIDEST = 10_000  # pixels of a PSF window
_RADII = 36  # with four times as many, margins of 110 published lenses within their limits change by at most 3e-4


@dataclass(frozen=True)
class View:
    """Fields, wavelengths and pixels at which a lens is evaluated.

    Attributes:
        fields: (F, 2) image points of the pinhole camera [mm].
        efl: focal length of the pinhole camera [mm].
        wavelengths_um: W wavelengths; the middle one is the reference.
        pixel_pitch_um: pixel pitch.
        kernel_size: width of the PSF window [pixels], odd.
        object_vergence: 1 / distance of the object in front of the first vertex [1/mm]; 0 for an object at infinity.

    Raises:
        InputError: the object is not in front of the lens, or `kernel_size` is not odd.
    """

    fields: Tensor
    efl: float
    wavelengths_um: tuple[float, ...]
    pixel_pitch_um: float
    kernel_size: int
    object_vergence: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.object_vergence < math.inf:
            raise InputError(
                f"object_vergence: expected 1 / distance [mm] of an object in front of the lens, or 0 for one at "
                f"infinity, got {self.object_vergence}"
            )
        if self.kernel_size not in range(1, _WIDEST, 2):
            raise InputError(f"kernel_size: expected an odd number of pixels below {_WIDEST}, got {self.kernel_size!r}")

    @property
    def tangents(self) -> Tensor:
        """(F, 2) direction tangents of the fields, as seen from the centre of the entrance pupil."""
        return self.fields / self.efl

    @property
    def object_distance(self) -> float:
        """Distance of the object in front of the first vertex [mm]."""
        return 1 / self.object_vergence if self.object_vergence else math.inf

    @property
    def radii(self) -> Tensor:
        """(F,) distances of the fields from the axis [mm]."""
        return self.fields.norm(dim=-1)

    @property
    def directions(self) -> Tensor:
        """(F, 2) tangential unit vectors, from the axis towards the fields; +y on the axis."""
        radius = self.radii[:, None]
        along_y = torch.tensor([0.0, 1.0], dtype=self.fields.dtype)
        return torch.where(radius > 0, self.fields / torch.where(radius > 0, radius, 1.0), along_y)

    @property
    def reference_um(self) -> float:
        """Reference (middle) wavelength [um]."""
        return self.wavelengths_um[len(self.wavelengths_um) // 2]

    def in_reference(self) -> "View":
        """Return the view at the reference wavelength only."""
        return replace(self, wavelengths_um=(self.reference_um,))

    def in_colours(self) -> "View":
        """Return the view at three wavelengths for red, green and blue: the longest, the reference, the shortest.

        If the reference is the longest or the shortest of three or more, green is one between them.
        """
        ordered = sorted(set(self.wavelengths_um), reverse=True)
        between = ordered[1:-1]
        green = self.reference_um if self.reference_um in between or not between else between[len(between) // 2]
        return replace(self, wavelengths_um=(ordered[0], green, ordered[-1]))

    def along_y(self, radii: Tensor) -> "View":
        """Return the view with fields at `radii` (F,) [mm] along +y."""
        return replace(self, fields=torch.stack([torch.zeros_like(radii), radii], -1))

    def at(self, points: Sequence[tuple[float, float]] | Tensor) -> "View":
        """Return the view at points (F, 2) of its quadrant, fractions of its largest |x| and |y|.

        The quadrant of fields along an axis is a square with the same corner.
        """
        fractions = torch.as_tensor(points, dtype=self.fields.dtype)
        extent = self.fields.abs().amax(0)
        if not extent.all():
            extent = (self.radii.max() / math.sqrt(2)).expand(2)
        return replace(self, fields=fractions * extent)

    def at_all_radii(self) -> "View":
        """Return the view along +y, so dense from the axis to the corner that limits and apertures hold in between."""
        return self.along_y(self.radii.max() * torch.linspace(0, 1, _RADII, dtype=self.fields.dtype))

    def in_meridian(self) -> "View":
        """Return the view with every field rotated onto +y, equivalent for a rotationally symmetric lens."""
        return self.along_y(self.radii)

    @property
    def named_fields(self) -> dict[str, int]:
        """Indices of the fields nearest to the axis, in the middle, and in the corner."""
        order = self.radii.argsort(stable=True).tolist()
        return {"axis": order[0], "middle": order[len(order) // 2], "corner": order[-1]}

    def in_all_quadrants(self) -> "View":
        """Return the view with all fields mirrored about both axes, without duplicates, for lenses without symmetry."""
        signs = torch.tensor([[1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=self.fields.dtype)
        mirrored = (self.fields[:, None] * signs).reshape(-1, 2) + 0.0  # no negative zeros
        return replace(
            self, fields=torch.tensor(list(dict.fromkeys(map(tuple, mirrored.tolist()))), dtype=self.fields.dtype)
        )


def view_of_spec(spec: Spec) -> View:
    """Return the nine fields, three wavelengths and the pixels of a specification."""
    fields = torch.tensor(spec.fields_mm, dtype=torch.float64)
    vergence = 1 / (spec.object_distance_mm or math.inf)
    return View(fields, spec.efl_mm, spec.wavelengths_um, spec.pixel_pitch_um, spec.kernel_size, vergence)


def drawn_points(draws: int, seed: int) -> Tensor:
    """Draw fields (9 draws, 2) uniformly in area: in each draw, one in each of 3 x 3 equal cells of the quadrant."""
    cell = torch.cartesian_prod(torch.arange(CELLS), torch.arange(CELLS)).flip(-1)
    within = torch.rand(draws, CELLS**2, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return ((cell + within) / CELLS).flatten(0, 1)
