"""Reference implementation of ray tracing in plain autograd, the oracle of the tests of `tracing`."""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.surface import Surface


def reference_trace(lens: Lens, rays: Rays, indices: Tensor) -> Rays:
    """Trace rays through every surface of a lens to its image plane: the same result as `tracing.trace`, but slower.

    At each surface: intersect it, refract (Snell's law), and measure z from the next vertex. First derivatives are
    exact in backward and in forward mode; second derivatives are not.

    Args:
        lens: S surfaces.
        rays: launched rays, of a shape that broadcasts with (..., W, N), z from the first vertex [mm].
        indices: (S + 1, W) refractive indices, as from `Lens.refractive_indices`.

    Returns:
        The rays on the image plane, z = 0. A lost ray stays at its last point, with its direction along the axis; it
        carries no gradient.
    """
    size = torch.broadcast_shapes(rays.x.shape, (indices.shape[1], 1))
    rays = Rays(*(v.expand(size) for v in vars(rays).values()))
    media = indices[..., None].unbind()
    for i, surface in enumerate(lens.surfaces):
        on_the_way = rays.valid
        rays = lens.pose.to_surface(i, rays) if lens.pose else rays
        rays = surface.intersect(rays, media[i])
        rays = surface.refract(rays, media[i], media[i + 1])
        rays = lens.pose.to_lens(i, rays) if lens.pose else rays
        lost_at = torch.where(on_the_way & ~rays.valid, i, rays.lost_at)
        rays = replace(rays, z=rays.z - lens.thickness[i], lost_at=lost_at)
    rays = Surface(curvature=0.0).intersect(rays, media[-1])  # the image plane
    x, y, path = (torch.where(rays.valid, v, v.detach()) for v in (rays.x, rays.y, rays.path))
    l, m, n = (torch.where(rays.valid, v, axis) for v, axis in ((rays.l, 0.0), (rays.m, 0.0), (rays.n, 1.0)))
    return Rays(x, y, torch.zeros_like(x), l, m, n, path, rays.status, rays.lost_at)
