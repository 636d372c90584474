"""Rays: where they are, where they go, and what became of them."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

GRAZING = 1e-6  # cosines to the axis or to a normal below this are no crossing
RIM = 2e-6  # excess of x^2 + y^2, relative, that still passes an aperture: rays on the rim do, however they round


class RayStatus(IntEnum):
    """What became of a ray."""

    OK = 0  # reached the image plane
    MISSED = 1  # never met a surface
    VIGNETTED = 2  # met it outside its clear aperture
    TOTAL_INTERNAL_REFLECTION = 3  # total internal reflection


@dataclass(frozen=True)
class Rays:
    """Rays of any common shape: where they are, where they go, and what became of them.

    Attributes:
        x, y, z: position [mm] relative to the vertex of the present surface (after `trace`: of the image plane).
        l, m, n: direction cosines, l^2 + m^2 + n^2 = 1.
        path: optical path n s since the launch [mm].
        status: `Fate` of each ray, int8.
        lost_at: surface at which the ray was lost, -1 while it is not, int8.
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
        """True for rays that reached the image plane."""
        return self.status == RayStatus.OK

    @property
    def vignetted(self) -> Tensor:
        """True for rays that met a surface outside its clear aperture: vignetted ones."""
        return self.status == RayStatus.VIGNETTED


def launch(x: Tensor, y: Tensor, z: Tensor, l: Tensor, m: Tensor, n: Tensor) -> Rays:
    """Rays that start at (x, y, z) [mm from the first vertex] along (l, m, n); the arguments broadcast."""
    x, y, z, l, m, n = torch.broadcast_tensors(x, y, z, l, m, n)
    status = torch.zeros(x.shape, dtype=torch.int8)
    return Rays(x, y, z, l, m, n, torch.zeros_like(x), status, status - 1)
