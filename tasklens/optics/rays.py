"""Rays: position, direction, optical path and status."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

GRAZING = 1e-6  # smallest cosine to the axis or to a normal at which a ray crosses a surface
RIM = 2e-6  # relative tolerance on x^2 + y^2 at an aperture, so that rays on the rim pass despite rounding


class RayStatus(IntEnum):
    """Status of a ray: valid, or the reason why it was lost."""

    OK = 0  # not lost
    MISSED = 1  # did not meet a surface
    VIGNETTED = 2  # met a surface outside its clear aperture
    TOTAL_INTERNAL_REFLECTION = 3


@dataclass(frozen=True)
class Rays:
    """Rays: tensors of one common shape.

    Attributes:
        x, y, z: position [mm] relative to the vertex of the current surface (after `trace`: of the image plane).
        l, m, n: direction cosines, l^2 + m^2 + n^2 = 1.
        path: optical path n s since the launch [mm].
        status: `RayStatus` of each ray, int8.
        lost_at: index of the surface at which the ray was lost, -1 for a valid ray, int8.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    l: Tensor
    m: Tensor
    n: Tensor
    path: Tensor
    status: Tensor
    lost_at: Tensor

    @property
    def valid(self) -> Tensor:
        """True for rays that are not lost."""
        return self.status == RayStatus.OK

    @property
    def vignetted(self) -> Tensor:
        """True for rays that met a surface outside its clear aperture."""
        return self.status == RayStatus.VIGNETTED


def describe_loss(rays: Rays, lost: Tensor) -> str:
    """Describe the surface and status of the first of the rays `lost`, to follow the word "lost" in a message."""
    surface = f"surface {int(rays.lost_at[lost][0])} (the first is 0)"
    return {
        RayStatus.MISSED: f"where it misses {surface}",
        RayStatus.VIGNETTED: f"at the clear aperture of {surface}",
        RayStatus.TOTAL_INTERNAL_REFLECTION: f"by total internal reflection at {surface}",
    }[RayStatus(int(rays.status[lost][0]))]


def passing(rays: Rays) -> Tensor:
    """Count the unvignetted rays of each field, (F,), at least one; energies are fractions of this count."""
    return (~rays.vignetted).sum((1, 2)).clamp(min=1)


def transmission(rays: Rays) -> Tensor:
    """Compute the fraction of unvignetted rays of each field and wavelength, (F, W), at least one ray."""
    return (~rays.vignetted).to(rays.x.dtype).mean(-1).clamp(min=1 / rays.x.shape[-1])


def launch(x: Tensor, y: Tensor, z: Tensor, l: Tensor, m: Tensor, n: Tensor) -> Rays:
    """Launch rays at (x, y, z) [mm from the first vertex] along (l, m, n); the arguments broadcast."""
    x, y, z, l, m, n = torch.broadcast_tensors(x, y, z, l, m, n)
    status = torch.zeros(x.shape, dtype=torch.int8)
    return Rays(x, y, z, l, m, n, torch.zeros_like(x), status, status - 1)
