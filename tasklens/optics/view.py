"""How a lens is used: its fields, colours and pixels."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.study.settings import Spec


@dataclass(frozen=True)
class View:
    """How a lens is looked at: where the fields are, in which colours, on which pixels.

    Attributes:
        fields: (F, 2) pinhole image points [mm].
        efl: focal length of that pinhole [mm].
        wavelengths: W of them [um]; the middle one is the reference.
        pixel_pitch: [um].
        kernel_size: width of the PSF window in pixels, odd.
    """

    fields: Tensor
    efl: float
    wavelengths: tuple[float, ...]
    pixel_pitch: float
    kernel_size: int

    @property
    def tangents(self) -> Tensor:
        """(F, 2) direction tangents of the fields."""
        return self.fields / self.efl

    @property
    def radii(self) -> Tensor:
        """(F,) distances of the fields from the axis [mm]."""
        return self.fields.norm(dim=-1)

    @property
    def directions(self) -> Tensor:
        """(F, 2) unit vectors from the axis towards the fields, the tangential direction of each; +y on the axis."""
        radius = self.radii[:, None]
        along_y = torch.tensor([0.0, 1.0], dtype=self.fields.dtype)
        return torch.where(radius > 0, self.fields / torch.where(radius > 0, radius, 1.0), along_y)

    @property
    def reference(self) -> float:
        """The middle wavelength [um]."""
        return self.wavelengths[len(self.wavelengths) // 2]

    def in_reference(self) -> "View":
        """The same view in the middle wavelength alone."""
        return replace(self, wavelengths=(self.reference,))

    def in_meridian(self) -> "View":
        """The same view with every field turned about the axis onto +y; to a lens of rotation that is the same."""
        return replace(self, fields=torch.stack([torch.zeros_like(self.radii), self.radii], -1))


def view_of_spec(spec: Spec) -> View:
    """The nine fields, three colours and the pixels of a specification."""
    fields = torch.tensor(spec.fields_mm, dtype=torch.float64)
    return View(fields, spec.efl_mm, spec.wavelengths_um, spec.pixel_pitch_um, spec.kernel_size)
