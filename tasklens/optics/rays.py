"""Sequential ray tracing in which every ray has a fate and every number a gradient."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from tasklens.optics.aspheres import sag
from tasklens.optics.lens import Lens

_NEWTON_STEPS = 30
_STEEP = 1e-3  # smallest derivative of the distance to a surface along a ray that Newton divides by
_STRIDE = 2.0  # longest Newton step [mm]: without a limit a ray may leave for good
_PARALLEL = 1e-6  # a direction cosine n below this runs along the surface and never comes to the image


class Fate(IntEnum):
    """What became of a ray."""

    HIT = 0  # reached the image plane
    MISSED = 1  # never met a surface
    OUTSIDE = 2  # met it outside its clear aperture
    REFLECTED = 3  # total internal reflection


@dataclass(frozen=True)
class Rays:
    """Rays of any common shape: where they are, where they go, and what became of them.

    Attributes:
        x, y, z: position [mm] relative to the vertex of the present surface (after `trace`: of the image plane).
        l, m, n: direction cosines, l^2 + m^2 + n^2 = 1.
        path: optical path n s since the launch [mm].
        fate: `Fate` of each ray, int8.
        lost_at: surface at which the ray was lost, -1 while it is not, int8.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    l: Tensor
    m: Tensor
    n: Tensor
    path: Tensor
    fate: Tensor
    lost_at: Tensor

    @property
    def valid(self) -> Tensor:
        """True for rays that reached the image plane."""
        return self.fate == Fate.HIT


def launch(x: Tensor, y: Tensor, z: Tensor, l: Tensor, m: Tensor, n: Tensor) -> Rays:
    """Rays that start at (x, y, z) [mm from the first vertex] along (l, m, n); the arguments broadcast."""
    x, y, z, l, m, n = torch.broadcast_tensors(x, y, z, l, m, n)
    fate = torch.zeros(x.shape, dtype=torch.int8)
    return Rays(x, y, z, l, m, n, torch.zeros_like(x), fate, fate - 1)


def _newton(position, direction, surface, t: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Distance t [mm] along each ray at which it meets the surface, and where that has converged."""
    (x, y, z), (l, m, n) = position, direction
    for _ in range(_NEWTON_STEPS):
        px, py = x + t * l, y + t * m
        value, slope, inside = sag(px * px + py * py, *surface)
        error = z + t * n - value
        converged = (error.abs() <= tolerance) & inside
        if converged.all():
            break
        derivative = n - 2 * slope * (px * l + py * m)
        steep = torch.where(
            derivative.abs() < _STEEP, torch.copysign(torch.full_like(n, _STEEP), derivative), derivative
        )
        t = t - (error / steep).clamp(-_STRIDE, _STRIDE)
    return t, converged


def intersect(position, direction, surface) -> tuple[Tensor, Tensor]:
    """Distance t [mm] at which rays meet z = sag(x^2 + y^2), and which of them do.

    Newton's iteration runs without a graph, from the base conic and, where that fails, from the vertex plane. One full
    Newton step with a graph follows, t - F(t) / F'(t): by the implicit function theorem it carries the exact
    derivative, in backward as well as in forward mode.

    Args:
        position, direction: triples of tensors (x, y, z) and (l, m, n), local to the vertex.
        surface: (curvature, conic, alpha), each without ray dimensions.
    """
    (x, y, z), (l, m, n) = position, direction
    with torch.no_grad():
        p, d, s = ([v.detach() for v in triple] for triple in (position, direction, surface))
        tolerance = 32 * torch.finfo(n.dtype).eps
        t, met = _newton(p, d, s, _conic_start(p, d, s[0], s[1]), tolerance)
        if not met.all():
            again, met_again = _newton(p, d, s, -p[2] / d[2], tolerance)
            t = torch.where(met, t, again)
            met = met | met_again
        t = torch.where(met, t, -p[2] / d[2])
        px, py = p[0] + t * d[0], p[1] + t * d[1]
        derivative = d[2] - 2 * sag(px * px + py * py, *s)[1] * (px * d[0] + py * d[1])
        met = met & (derivative > _PARALLEL)  # else it grazes, or comes through from behind
        derivative = torch.where(met, derivative, 1.0)
    px, py = x + t * l, y + t * m
    error = z + t * n - sag(px * px + py * py, *surface)[0]
    return torch.where(met, t - error / derivative, -z / n), met


def _conic_start(position, direction, curvature: Tensor, conic: Tensor) -> Tensor:
    """Distance to the base conic c (x^2 + y^2 + (1 + k) z^2) = 2 z near its vertex, or to the vertex plane."""
    (x, y, z), (l, m, n) = position, direction
    a = curvature * (l * l + m * m + (1 + conic) * n * n)
    b = curvature * (x * l + y * m + (1 + conic) * z * n) - n
    c = curvature * (x * x + y * y + (1 + conic) * z * z) - 2 * z
    discriminant = b * b - a * c
    root = -b + torch.sqrt(discriminant.clamp(min=0))
    return torch.where((discriminant > 0) & (root > _PARALLEL), c / root.clamp(min=_PARALLEL), -z / n)


def trace(lens: Lens, rays: Rays, indices: Tensor, record: list | None = None) -> Rays:
    """Trace rays through every surface of a lens to its image plane.

    A lost ray stays where it was lost, turned along the axis, so that no later number is infinite.

    Args:
        lens: S surfaces.
        rays: as launched, of shape (..., W, N).
        indices: (S + 1, W) refractive indices, as from `Lens.refractive_indices`.
        record: if given, the Rays behind every surface are appended to it.

    Returns:
        The rays on the image plane, z = 0.
    """
    x, y, z, l, m, n = rays.x, rays.y, rays.z, rays.l, rays.m, rays.n
    path, fate, lost_at = rays.path, rays.fate, rays.lost_at
    alive = fate == Fate.HIT
    along = n > _PARALLEL  # a ray that runs along the first surface or away from it never meets it
    fate = torch.where(alive & ~along, torch.tensor(Fate.MISSED, dtype=torch.int8), fate)
    lost_at = torch.where(alive & ~along, torch.tensor(0, dtype=torch.int8), lost_at)
    alive = alive & along
    l, m, n = torch.where(along, l, 0.0), torch.where(along, m, 0.0), torch.where(along, n, 1.0)
    for i in range(len(lens.media)):
        surface = (lens.curvature[i], lens.conic[i], lens.alpha[i])
        before, behind = indices[i][:, None], indices[i + 1][:, None]
        t, met = intersect((x, y, z), (l, m, n), surface)
        x, y = x + t * l, y + t * m
        z, slope, _ = sag(x * x + y * y, *surface)
        z = torch.where(met, z, 0.0)
        path = path + torch.where(alive, before * t, 0.0)

        # Snell's law with the unnormalised normal g = (-2 x s', -2 y s', 1), s' = d sag / d u:
        # d' = mu d + g (sqrt(g^2 (1 - mu^2) + mu^2 (d g)^2) - mu (d g)) / g^2
        slope = torch.where(met, slope, 0.0)
        gx, gy = -2 * slope * x, -2 * slope * y
        g2 = gx * gx + gy * gy + 1
        cosine = l * gx + m * gy + n
        mu = before / behind
        argument = g2 * (1 - mu * mu) + (mu * cosine) ** 2
        transmitted = argument > 0
        bend = (torch.sqrt(torch.where(transmitted, argument, 1.0)) - mu * cosine) / g2
        lx, my, nz = mu * l + bend * gx, mu * m + bend * gy, mu * n + bend

        within = x * x + y * y <= (lens.semi_diameter[i] * (1 + 1e-6)) ** 2  # rays on the rim pass
        onward = transmitted & (nz > _PARALLEL)
        for code, passed in ((Fate.MISSED, met), (Fate.OUTSIDE, within), (Fate.REFLECTED, onward)):
            lost = alive & ~passed
            fate = torch.where(lost, torch.tensor(code, dtype=torch.int8), fate)
            lost_at = torch.where(lost, torch.tensor(i, dtype=torch.int8), lost_at)
            alive = alive & passed
        l, m, n = torch.where(alive, lx, 0.0), torch.where(alive, my, 0.0), torch.where(alive, nz, 1.0)
        if record is not None:
            record.append(Rays(x, y, z, l, m, n, path, fate, lost_at))
        z = z - lens.thickness[i]
    t = -z / n
    path = path + torch.where(alive, indices[-1][:, None] * t, 0.0)
    return Rays(x + t * l, y + t * m, torch.zeros_like(z), l, m, n, path, fate, lost_at)
