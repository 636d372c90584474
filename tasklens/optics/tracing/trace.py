"""Differentiable sequential ray tracing; every lost ray has a status and a surface."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import torch
import torch.autograd.forward_ad as fwAD
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.optics.rays import GRAZING, RIM, Rays, RayStatus
from tasklens.optics.tracing.intersection import PreparedSurface, distance, surfaces
from tasklens.optics.tracing.lost_rays import LostRays
from tasklens.optics.tracing.refraction import RayState, Refraction, refract, refract_jvp, refract_vjp

_TILE = 2**19  # bytes of one array: above, caches overflow; below, calls weigh more (benchmarks/README.md)


class _Notes:
    """Inputs of a `_Sequence` that are no tensors, and the values stored for its derivatives."""

    def __init__(self, semi_diameters: list[float], record: list[Rays] | None, keep: bool, to_index: bool):
        self.semi_diameters = semi_diameters
        self.record = record
        self.to_index = to_index
        self.refractions: list[Refraction | None] | None = [] if keep else None  # None: a plane that bends nothing
        self.losses: LostRays
        self.surfaces: list[PreparedSurface]
        self.last: tuple[Tensor, ...]  # l, m, n and t from the last surface to the image plane


class _Sequence(torch.autograd.Function):
    """Trace of rays (F, W, N) through all surfaces, with indices (S + 1, W, 1): loop over `refract` and derivatives."""

    @staticmethod
    def forward(notes: _Notes, status, lost_at, x, y, z, l, m, n, path, indices, curvature, conic, alpha, thickness):
        notes.losses = losses = LostRays(status, lost_at)
        notes.surfaces = surfaces(curvature, conic, alpha)
        rays = RayState(x, y, z, l, m, n)
        if bool(status.any()):
            rays = losses.park(status != RayStatus.OK, rays, path)
        if float(rays.n.min()) <= GRAZING:  # along the first surface or away from it
            rays = losses.add(rays.n <= GRAZING, RayStatus.MISSED, 0, rays, path)
        index, space = indices.unbind(), thickness.unbind()
        for i, (surface, semi_diameter) in enumerate(zip(notes.surfaces, notes.semi_diameters, strict=True)):
            media = (index[i], index[i + 1])
            refraction = None
            if surface.plane and not notes.to_index and torch.equal(*media):
                rays = _through(rays, path, i, semi_diameter, media[0], losses)
            else:
                rays, path, refraction = _onward(rays, path, i, surface, semi_diameter, media, losses)
            if notes.refractions is not None:
                notes.refractions.append(refraction)
            if notes.record is not None:
                at, so_far = (rays, path) if refraction is not None else _on_plane(rays, path, media[0])
                x, y, z, so_far = losses.where_lost(*at[:3], so_far)
                notes.record.append(Rays(x, y, z, *rays[3:], so_far, losses.status, losses.lost_at))
            del refraction  # or its memory would not serve the next one
            rays = rays._replace(z=rays.z - space[i])
        x, y, z, l, m, n = rays
        t = -z / n
        x, y, path = torch.addcmul(x, t, l), torch.addcmul(y, t, m), torch.addcmul(path, index[-1], t)
        x, y, _, path = losses.where_lost(x, y, z, path)
        notes.last = (l.detach(), m.detach(), n.detach(), t)
        return x, y, l, m, n, path, losses.status, losses.lost_at

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.notes, ctx.orders = inputs[0], inputs[13].shape[1]
        ctx.save_for_backward(inputs[10])
        ctx.save_for_forward(inputs[10])
        ctx.mark_non_differentiable(*output[6:])
        ctx.set_materialize_grads(False)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients):
        notes, (indices,) = ctx.notes, ctx.saved_tensors
        zero, index = indices.new_zeros(()), indices.unbind()
        b_x, b_y, b_l, b_m, b_n, b_path = (zero if g is None else notes.losses.masked(g) for g in gradients[:6])
        wanted = notes.to_index
        l, m, n, t = notes.last
        tau = torch.addcmul(torch.addcmul(b_path * index[-1], b_x, l), b_y, m) / n
        b_l, b_m, b_n = torch.addcmul(b_l, t, b_x), torch.addcmul(b_m, t, b_y), torch.addcmul(b_n, t, tau, value=-1)
        rays = RayState(b_x, b_y, -tau, b_l, b_m, b_n)
        b_index = [_over_rays(t * b_path, index[-1])] if wanted else []
        b_shapes, b_spaces = [], []
        for i in reversed(range(len(notes.surfaces))):
            refraction = notes.refractions[i]
            b_spaces.append(-rays.z.sum())
            if refraction is None:
                b_shapes.append(None)
                continue
            rays, b_shape, b_mu = refract_vjp(rays, b_path * index[i], refraction, notes.surfaces[i], wanted)
            b_shapes.append(b_shape)
            if wanted:
                b_ratio = b_mu / index[i + 1]
                b_index[-1] = b_index[-1] - _over_rays(b_ratio * refraction.mu, index[i])
                b_index.append(_over_rays(b_ratio + refraction.t * b_path, index[i]))
        none = (zero, zero, indices.new_zeros(ctx.orders))
        b_curvature, b_conic, b_alpha = (torch.stack(v[::-1]) for v in zip(*(b or none for b in b_shapes), strict=True))
        b_path = None if gradients[5] is None else b_path
        b_indices = torch.stack(b_index[::-1]) if wanted else None
        return None, None, None, *rays, b_path, b_indices, b_curvature, b_conic, b_alpha, torch.stack(b_spaces[::-1])

    @staticmethod
    def jvp(ctx, _notes, _status, _lost_at, *changes):
        (indices,) = ctx.saved_tensors
        *rays, path, d_indices, curvature, conic, alpha, thickness = changes
        return *_pushed(ctx.notes, indices, rays, path, d_indices, curvature, conic, alpha, thickness), None, None


def _pushed(notes: _Notes, indices: Tensor, rays, d_path, d_indices, curvature, conic, alpha, thickness, record=None):
    """Propagate small changes of rays (..., F, W, N) and surfaces (..., S) to the image plane; None means zero.

    Those of x and y behind every surface are appended to `record`.
    """
    zero, index = indices.new_zeros(()), indices.unbind()
    rays, d_path = RayState(*(zero if v is None else v for v in rays)), zero if d_path is None else d_path

    def at(change: Tensor | None, i: int) -> Tensor:
        return zero if change is None else change[..., i, None, None, None]

    for i, (refraction, surface) in enumerate(zip(notes.refractions, notes.surfaces, strict=True)):
        if refraction is not None:
            before, behind = (zero, zero) if d_indices is None else (d_indices[i], d_indices[i + 1])
            coefficients = torch.zeros_like(surface.orders) if alpha is None else alpha[..., i, :]
            shape = (at(curvature, i), at(conic, i), coefficients)
            rays, dt = refract_jvp(rays, (before - refraction.mu * behind) / index[i + 1], shape, refraction, surface)
            d_path = d_path + before * refraction.t + index[i] * dt
        if record is not None:
            record.append((rays.x, rays.y))
        rays = rays._replace(z=rays.z - at(thickness, i))
    dx, dy, dz, dl, dm, dn = rays
    l, m, n, t = notes.last
    dt = -(dz + t * dn) / n
    d_path = d_path + (zero if d_indices is None else d_indices[-1]) * t + index[-1] * dt
    ends = (dx + t * dl + dt * l, dy + t * dm + dt * m, dl, dm, dn, d_path)
    return tuple(notes.losses.masked(v) for v in ends)


def _over_rays(gradient: Tensor, index: Tensor) -> Tensor:
    """Sum the gradients of rays to the gradient of an index (W, 1)."""
    return gradient.sum_to_size(1, *index.shape)[0]


def _onward(
    rays: RayState, path: Tensor, i: int, surface: PreparedSurface, semi_diameter: float, media: tuple, losses: LostRays
) -> tuple[RayState, Tensor, Refraction]:
    """Trace rays, z from the vertex of surface i, from before it to behind it, with optical path and lost rays."""
    x, y, z, l, m, n = rays
    t = z / n  # back to the vertex plane
    x, y = torch.addcmul(x, t, l, value=-1), torch.addcmul(y, t, m, value=-1)
    beyond, u, h, met = distance(x, y, l, m, n, surface)
    if met is not None:
        *_, l, m, n = losses.add(~met, RayStatus.MISSED, i, rays, path)
        x, y = torch.where(met, x, 0.0), torch.where(met, y, 0.0)
    t, x, y, z = beyond - t, torch.addcmul(x, beyond, l), torch.addcmul(y, beyond, m), beyond * n
    path = torch.addcmul(path, media[0], t)
    behind, squared, refraction = refract(RayState(x, y, z, l, m, n), t, u, h, media[0] / media[1], surface)
    limit = _limit(semi_diameter)
    if limit < math.inf and float(u.max()) > limit:
        behind = losses.add(u > limit, RayStatus.VIGNETTED, i, behind, path)
    if not (float(squared.min()) > GRAZING**2 and float(behind.n.min()) > GRAZING):
        lost = (squared <= GRAZING**2) | (behind.n <= GRAZING)
        behind = losses.add(lost, RayStatus.TOTAL_INTERNAL_REFLECTION, i, behind, path)
    return behind, path, refraction


def _through(rays: RayState, path: Tensor, i: int, semi_diameter: float, index: Tensor, losses: LostRays) -> RayState:
    """Vignette rays at a plane without refraction, such as a stop in air; other rays are unchanged."""
    limit = _limit(semi_diameter)
    if limit < math.inf:
        at, so_far = _on_plane(rays, path, index)
        u = torch.addcmul(at.x * at.x, at.y, at.y)
        if float(u.max()) > limit:
            stopped = u > limit
            return RayState(
                *map(partial(torch.where, stopped), losses.add(stopped, RayStatus.VIGNETTED, i, at, so_far), rays)
            )
    return rays


def _on_plane(rays: RayState, path: Tensor, index: Tensor) -> tuple[RayState, Tensor]:
    """Move rays and their optical paths to the plane z = 0."""
    x, y, z, l, m, n = rays
    t = z / n
    at = RayState(torch.addcmul(x, t, l, value=-1), torch.addcmul(y, t, m, value=-1), torch.zeros_like(n), l, m, n)
    return at, torch.addcmul(path, index, t, value=-1)


def _limit(semi_diameter: float) -> float:
    """Return the largest x^2 + y^2 that passes an aperture, rays on the rim included."""
    return semi_diameter * semi_diameter * (1 + RIM)


def _carries_derivative(values: Tensor) -> bool:
    return (torch.is_grad_enabled() and values.requires_grad) or fwAD.unpack_dual(values).tangent is not None


def trace(lens: Lens, rays: Rays, indices: Tensor) -> Rays:
    """Trace rays through every surface of a lens to its image plane.

    Differentiable, in backward and in forward mode, in the rays, the indices and every parameter of the lens but its
    apertures. A lost ray stays at the last point that it reached, turned along the axis; it carries no gradient.

    Args:
        lens: S surfaces.
        rays: as launched, of a shape that broadcasts with (..., W, N).
        indices: (S + 1, W) refractive indices, as from `Lens.refractive_indices`.

    Returns:
        The rays on the image plane, z = 0.
    """
    return _traced(lens, rays, indices, None)


def trace_full(lens: Lens, rays: Rays, indices: Tensor) -> tuple[Rays, list[Rays]]:
    """Trace rays as `trace` does; return also the rays behind every surface, z from its vertex, without gradient."""
    record: list[Rays] = []
    image = _traced(lens, rays, indices, record)
    return image, [Rays(*(v.reshape(image.x.shape) for v in vars(at).values())) for at in record]


def _traced(lens: Lens, rays: Rays, indices: Tensor, record: list[Rays] | None) -> Rays:
    size = torch.broadcast_shapes(rays.x.shape, (indices.shape[1], 1))
    stack = (-1, *size[-2:])

    def batch(values: Tensor) -> Tensor:
        return values.expand(size).reshape(stack)

    start = [batch(v) for v in _parts(rays)]
    fields = len(start[0])
    tile = fields if record is not None else max(1, _TILE // (size[-2] * size[-1] * start[2].element_size()))
    shape = (lens.curvature, lens.conic, lens.alpha, lens.thickness)
    to_index = _carries_derivative(indices)
    keep = to_index or any(_carries_derivative(v) for v in (*shape, *start))
    semi_diameters = lens.semi_diameter.tolist()
    ends = []
    for first in range(0, fields, tile):  # rays do not know of each other
        notes = _Notes(semi_diameters, record, keep, to_index)
        ends.append(_Sequence.apply(notes, *(v[first : first + tile] for v in start), indices[..., None], *shape))
    ends = [torch.cat(v) if len(v) > 1 else v[0] for v in zip(*ends, strict=True)]
    x, y, l, m, n, path, status, lost_at = (v.reshape(size) for v in ends)
    return Rays(x, y, torch.zeros_like(x), l, m, n, path, status, lost_at)


def _parts(rays: Rays) -> tuple[Tensor, ...]:
    """Return the components of rays in the order of `_Sequence`."""
    return rays.status, rays.lost_at, rays.x, rays.y, rays.z, rays.l, rays.m, rays.n, rays.path


class Derivative(NamedTuple):
    """Changes of rays for V changes of a lens, of a shape that broadcasts with (V, F, W, N).

    Attributes:
        image: of the rays on the image plane.
        behind: of x and y of the rays behind every surface.
    """

    image: RayState
    behind: list[tuple[Tensor, Tensor]]


class Linearised(NamedTuple):
    """Rays through a lens, and their derivative by the lens.

    Attributes:
        image: rays on the image plane.
        behind: rays behind every surface.
        derivative: takes V changes of the lens at once, `curvature`, `conic` and `thickness` (V, S), `alpha` (V, S, M),
            where a missing one is zero. The rays start as they are, whatever the lens.
    """

    image: Rays
    behind: list[Rays]
    derivative: Callable[[Mapping[str, Tensor]], Derivative]


def linearise(lens: Lens, rays: Rays, indices: Tensor) -> Linearised:
    """Trace rays (F, W, N) as `trace_full` does but without a graph, with the derivative along changes of the lens."""
    record: list[Rays] = []
    notes = _Notes(lens.semi_diameter.tolist(), record, keep=True, to_index=False)
    shape = (lens.curvature, lens.conic, lens.alpha, lens.thickness)
    with torch.no_grad():
        x, y, l, m, n, path, status, lost_at = _Sequence.forward(notes, *_parts(rays), indices[..., None], *shape)

    def derivative(changes: Mapping[str, Tensor]) -> Derivative:
        kinds = (changes.get(name) for name in ("curvature", "conic", "alpha", "thickness"))
        behind: list[tuple[Tensor, Tensor]] = []
        with torch.no_grad():
            dx, dy, dl, dm, dn, _ = _pushed(notes, indices[..., None], (None,) * 6, None, None, *kinds, behind)
        return Derivative(RayState(dx, dy, torch.zeros_like(dx), dl, dm, dn), behind)

    return Linearised(Rays(x, y, torch.zeros_like(x), l, m, n, path, status, lost_at), record, derivative)
