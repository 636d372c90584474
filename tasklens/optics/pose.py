"""Poses of surfaces: decentres and tilts."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.optics.rays import Rays


@dataclass(frozen=True)
class Pose:
    """Poses of S surfaces: a point P' in the axes of a surface is at P = R P' + p relative to its nominal vertex.

    Attributes:
        rotation: (S, 3, 3) R, whose columns are the axes of the surface.
        position: (S, 3) p, from the nominal vertex to that of the surface [mm].
    """

    rotation: Tensor
    position: Tensor

    @classmethod
    def nominal(cls, surfaces: int, dtype: torch.dtype) -> "Pose":
        """Return the poses of surfaces that are neither decentred nor tilted."""
        return cls(torch.eye(3, dtype=dtype).expand(surfaces, 3, 3), torch.zeros(surfaces, 3, dtype=dtype))

    def moved(self, surfaces: list[int], decentre: Tensor, tilt: Tensor, pivots: Tensor) -> "Pose":
        """Move surfaces as one rigid body: turn them about a pivot, then shift them.

        P -> pivot + (dx, dy, 0) + M (P - pivot),  M = Rx(tilt_x) Ry(tilt_y), right-handed

        Args:
            decentre: (2,) dx, dy [mm].
            tilt: (2,) angles about x and y [rad].
            pivots: (len(surfaces), 3) the pivot from the nominal vertex of each surface [mm].
        """
        turn = _about_x(tilt[0]) @ _about_y(tilt[1])
        shift = torch.cat([decentre, torch.zeros_like(decentre[:1])])
        index = torch.tensor(surfaces)
        position = pivots + shift + (self.position[index] - pivots) @ turn.T
        rotation = turn @ self.rotation[index]
        return Pose(self.rotation.index_copy(0, index, rotation), self.position.index_copy(0, index, position))

    def to_surface(self, i: int, rays: Rays) -> Rays:
        """Transform rays from the axes of the lens, at the nominal vertex i, to the axes of the surface."""
        point = torch.stack([rays.x, rays.y, rays.z], -1) - self.position[i]
        return _with(rays, point @ self.rotation[i], torch.stack([rays.l, rays.m, rays.n], -1) @ self.rotation[i])

    def to_lens(self, i: int, rays: Rays) -> Rays:
        """Transform rays from the axes of surface i to the axes of the lens, at the nominal vertex."""
        turn = self.rotation[i].T
        point = torch.stack([rays.x, rays.y, rays.z], -1) @ turn + self.position[i]
        return _with(rays, point, torch.stack([rays.l, rays.m, rays.n], -1) @ turn)


def _with(rays: Rays, point: Tensor, direction: Tensor) -> Rays:
    (x, y, z), (l, m, n) = point.unbind(-1), direction.unbind(-1)
    return replace(rays, x=x, y=y, z=z, l=l, m=m, n=n)


def _about_x(angle: Tensor) -> Tensor:
    one, zero, c, s = torch.ones_like(angle), torch.zeros_like(angle), torch.cos(angle), torch.sin(angle)
    return torch.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def _about_y(angle: Tensor) -> Tensor:
    one, zero, c, s = torch.ones_like(angle), torch.zeros_like(angle), torch.cos(angle), torch.sin(angle)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
