"""Lost rays: their status, surface and last point."""

import torch
from torch import Tensor

from tasklens.optics.rays import RayStatus
from tasklens.optics.tracing.refraction import RayState


class LostRays:
    """Status, surface and last point of lost rays, which are then traced along the axis to stay finite."""

    def __init__(self, status: Tensor, lost_at: Tensor):
        self.status, self.lost_at = status, lost_at
        self.alive: Tensor | None = None  # None while nothing is lost: the common case pays for nothing
        self.last: tuple[Tensor, ...]  # x, y, z and path where a ray was lost

    def add(self, lost: Tensor, status: RayStatus, surface: int, rays: RayState, path: Tensor) -> RayState:
        """Record rays as lost at their present position, and move them to the axis."""
        self.status = torch.where(lost, torch.tensor(status, dtype=torch.int8), self.status)
        self.lost_at = torch.where(lost, torch.tensor(surface, dtype=torch.int8), self.lost_at)
        return self.park(lost, rays, path)

    def park(self, lost: Tensor, rays: RayState, path: Tensor) -> RayState:
        """Move rays to the axis, and record their last point."""
        now = (*rays[:3], path)
        if self.alive is None:
            self.alive, self.last = ~lost, now
        else:
            self.alive = self.alive & ~lost
            self.last = tuple(torch.where(lost, v, old) for v, old in zip(now, self.last, strict=True))
        axis = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        return RayState(*(torch.where(lost, on_axis, v) for on_axis, v in zip(axis, rays, strict=True)))

    def where_lost(self, *now: Tensor) -> tuple[Tensor, ...]:
        """Return (x, y, z, path), for lost rays those of their last point."""
        if self.alive is None:
            return now
        return tuple(torch.where(self.alive, v, old) for v, old in zip(now, self.last, strict=True))

    def masked(self, values: Tensor) -> Tensor:
        """Return the values, zero for lost rays."""
        return values if self.alive is None else torch.where(self.alive, values, 0.0)
