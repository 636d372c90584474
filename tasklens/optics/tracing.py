"""Sequential ray tracing in which every ray has a fate and every number a gradient."""

import math
from functools import partial

import torch
import torch.autograd.forward_ad as fwAD
from torch import Tensor

from tasklens.optics.intersection import GRAZING, Surface, distance, surfaces
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Fate, Rays
from tasklens.optics.refraction import Bundle, Crossing, cross, pull, push

_TILE = 2**19  # bytes of one array: above, caches overflow; below, calls weigh more (benchmarks/README.md)


class _Losses:
    """Which rays were lost, where and why; lost rays run on along the axis, where nothing happens to them."""

    def __init__(self, fate: Tensor, lost_at: Tensor):
        self.fate, self.lost_at = fate, lost_at
        self.alive: Tensor | None = None  # None while nothing is lost: the common case pays for nothing
        self.last: tuple[Tensor, ...]  # x, y, z and path where a ray was lost

    def add(self, lost: Tensor, fate: Fate, surface: int, rays: Bundle, path: Tensor) -> Bundle:
        """Note that rays are lost where they are now, and park them."""
        self.fate = torch.where(lost, torch.tensor(fate, dtype=torch.int8), self.fate)
        self.lost_at = torch.where(lost, torch.tensor(surface, dtype=torch.int8), self.lost_at)
        return self.park(lost, rays, path)

    def park(self, lost: Tensor, rays: Bundle, path: Tensor) -> Bundle:
        """Put rays on the axis."""
        now = (*rays[:3], path)
        if self.alive is None:
            self.alive, self.last = ~lost, now
        else:
            self.alive = self.alive & ~lost
            self.last = tuple(torch.where(lost, v, old) for v, old in zip(now, self.last, strict=True))
        axis = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        return Bundle(*(torch.where(lost, on_axis, v) for on_axis, v in zip(axis, rays, strict=True)))

    def where_lost(self, *now: Tensor) -> tuple[Tensor, ...]:
        """(x, y, z, path), for lost rays those of their last point."""
        if self.alive is None:
            return now
        return tuple(torch.where(self.alive, v, old) for v, old in zip(now, self.last, strict=True))

    def masked(self, values: Tensor) -> Tensor:
        """The values, zero for a lost ray."""
        return values if self.alive is None else torch.where(self.alive, values, 0.0)


class _Notes:
    """What a `_Sequence` is told beside tensors, and what it keeps for its derivatives."""

    def __init__(self, semi_diameters: list[float], record: list[Rays] | None, keep: bool, to_index: bool):
        self.semi_diameters = semi_diameters
        self.record = record
        self.to_index = to_index
        self.crossings: list[Crossing | None] | None = [] if keep else None  # None: a plane that bends nothing
        self.losses: _Losses
        self.surfaces: list[Surface]
        self.last: tuple[Tensor, ...]  # l, m, n and t from the last surface to the image plane


class _Sequence(torch.autograd.Function):
    """Rays (F, W, N) through all surfaces, with indices (S + 1, W, 1): the loop over `cross`, `push` and `pull`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(notes: _Notes, fate, lost_at, x, y, z, l, m, n, path, indices, curvature, conic, alpha, thickness):
        notes.losses = losses = _Losses(fate, lost_at)
        notes.surfaces = surfaces(curvature, conic, alpha)
        rays = Bundle(x, y, z, l, m, n)
        if bool(fate.any()):
            rays = losses.park(fate != Fate.HIT, rays, path)
        if float(rays.n.min()) <= GRAZING:  # along the first surface or away from it
            rays = losses.add(rays.n <= GRAZING, Fate.MISSED, 0, rays, path)
        index, space = indices.unbind(), thickness.unbind()
        for i, (surface, semi_diameter) in enumerate(zip(notes.surfaces, notes.semi_diameters, strict=True)):
            media = (index[i], index[i + 1])
            crossing = None
            if surface.plane and not notes.to_index and torch.equal(*media):
                rays = _through(rays, path, i, semi_diameter, media[0], losses)
            else:
                rays, path, crossing = _onward(rays, path, i, surface, semi_diameter, media, losses)
            if notes.crossings is not None:
                notes.crossings.append(crossing)
            if notes.record is not None:
                at, so_far = (rays, path) if crossing is not None else _on_plane(rays, path, media[0])
                x, y, z, so_far = losses.where_lost(*at[:3], so_far)
                notes.record.append(Rays(x, y, z, *rays[3:], so_far, losses.fate, losses.lost_at))
            del crossing  # or its memory would not serve the next one
            rays = rays._replace(z=rays.z - space[i])
        x, y, z, l, m, n = rays
        t = -z / n
        x, y, path = torch.addcmul(x, t, l), torch.addcmul(y, t, m), torch.addcmul(path, index[-1], t)
        x, y, _, path = losses.where_lost(x, y, z, path)
        notes.last = (l.detach(), m.detach(), n.detach(), t)
        return x, y, l, m, n, path, losses.fate, losses.lost_at

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
        rays = Bundle(b_x, b_y, -tau, b_l, b_m, b_n)
        b_index = [_over_rays(t * b_path, index[-1])] if wanted else []
        b_shapes, b_spaces = [], []
        for i in reversed(range(len(notes.surfaces))):
            crossing = notes.crossings[i]
            b_spaces.append(-rays.z.sum())
            if crossing is None:
                b_shapes.append(None)
                continue
            rays, b_shape, b_mu = pull(rays, b_path * index[i], crossing, notes.surfaces[i], wanted)
            b_shapes.append(b_shape)
            if wanted:
                b_ratio = b_mu / index[i + 1]
                b_index[-1] = b_index[-1] - _over_rays(b_ratio * crossing.mu, index[i])
                b_index.append(_over_rays(b_ratio + crossing.t * b_path, index[i]))
        none = (zero, zero, indices.new_zeros(ctx.orders))
        b_curvature, b_conic, b_alpha = (torch.stack(v[::-1]) for v in zip(*(b or none for b in b_shapes), strict=True))
        b_path = None if gradients[5] is None else b_path
        b_indices = torch.stack(b_index[::-1]) if wanted else None
        return None, None, None, *rays, b_path, b_indices, b_curvature, b_conic, b_alpha, torch.stack(b_spaces[::-1])

    @staticmethod
    def jvp(ctx, _notes, _fate, _lost_at, *changes):
        notes, (indices,) = ctx.notes, ctx.saved_tensors
        zero, index = indices.new_zeros(()), indices.unbind()
        *rays, d_path, d_indices, dc, dk, da, d_space = (zero if v is None else v for v in changes)
        rays = Bundle(*rays)

        def row(change: Tensor, i: int) -> Tensor:
            return change[i] if change.dim() else change

        for i, (crossing, surface) in enumerate(zip(notes.crossings, notes.surfaces, strict=True)):
            if crossing is not None:
                mu_change = (row(d_indices, i) - crossing.mu * row(d_indices, i + 1)) / index[i + 1]
                shape = (row(dc, i), row(dk, i), da[i] if da.dim() else torch.zeros_like(surface.orders))
                rays, dt = push(rays, mu_change, shape, crossing, surface)
                d_path = d_path + row(d_indices, i) * crossing.t + index[i] * dt
            rays = rays._replace(z=rays.z - row(d_space, i))
        dx, dy, dz, dl, dm, dn = rays
        l, m, n, t = notes.last
        dt = -(dz + t * dn) / n
        d_path = d_path + row(d_indices, -1) * t + index[-1] * dt
        ends = (dx + t * dl + dt * l, dy + t * dm + dt * m, dl, dm, dn, d_path)
        return *(notes.losses.masked(v) for v in ends), None, None


def _over_rays(gradient: Tensor, index: Tensor) -> Tensor:
    """The gradient at an index (W, 1) from that at each ray."""
    return gradient.sum_to_size(1, *index.shape)[0]


def _onward(
    rays: Bundle, path: Tensor, i: int, surface: Surface, semi_diameter: float, media: tuple, losses: _Losses
) -> tuple[Bundle, Tensor, Crossing]:
    """Rays before surface i, z from its vertex, to behind it, and their optical path; the lost are noted and parked."""
    x, y, z, l, m, n = rays
    t = z / n  # back to the vertex plane
    x, y = torch.addcmul(x, t, l, value=-1), torch.addcmul(y, t, m, value=-1)
    beyond, u, h, met = distance(x, y, l, m, n, surface)
    if met is not None:
        *_, l, m, n = losses.add(~met, Fate.MISSED, i, rays, path)
        x, y = torch.where(met, x, 0.0), torch.where(met, y, 0.0)
    t, x, y, z = beyond - t, torch.addcmul(x, beyond, l), torch.addcmul(y, beyond, m), beyond * n
    path = torch.addcmul(path, media[0], t)
    behind, squared, crossing = cross(x, y, z, l, m, n, t, u, h, media[0] / media[1], surface)
    limit = _limit(semi_diameter)
    if limit < math.inf and float(u.max()) > limit:
        behind = losses.add(u > limit, Fate.OUTSIDE, i, behind, path)
    if not (float(squared.min()) > GRAZING**2 and float(behind.n.min()) > GRAZING):
        lost = (squared <= GRAZING**2) | (behind.n <= GRAZING)
        behind = losses.add(lost, Fate.REFLECTED, i, behind, path)
    return behind, path, crossing


def _through(rays: Bundle, path: Tensor, i: int, semi_diameter: float, index: Tensor, losses: _Losses) -> Bundle:
    """Rays at a plane in one medium, such as a stop in air: as before it, but for those that its aperture stops."""
    limit = _limit(semi_diameter)
    if limit < math.inf:
        at, so_far = _on_plane(rays, path, index)
        u = torch.addcmul(at.x * at.x, at.y, at.y)
        if float(u.max()) > limit:
            stopped = u > limit
            return Bundle(*map(partial(torch.where, stopped), losses.add(stopped, Fate.OUTSIDE, i, at, so_far), rays))
    return rays


def _on_plane(rays: Bundle, path: Tensor, index: Tensor) -> tuple[Bundle, Tensor]:
    """Rays and their paths where they cross the plane z = 0."""
    x, y, z, l, m, n = rays
    t = z / n
    at = Bundle(torch.addcmul(x, t, l, value=-1), torch.addcmul(y, t, m, value=-1), torch.zeros_like(n), l, m, n)
    return at, torch.addcmul(path, index, t, value=-1)


def _limit(semi_diameter: float) -> float:
    """Largest x^2 + y^2 that passes an aperture: rays on the rim do."""
    return semi_diameter * semi_diameter * (1 + 2e-6)


def _carries_derivative(values: Tensor) -> bool:
    return (torch.is_grad_enabled() and values.requires_grad) or fwAD.unpack_dual(values).tangent is not None


def trace(lens: Lens, rays: Rays, indices: Tensor, record: list | None = None) -> Rays:
    """Trace rays through every surface of a lens to its image plane.

    Differentiable, in backward and in forward mode, in the rays, the indices and every parameter of the lens but its
    apertures. A lost ray stays at the last point that it reached, turned along the axis; it carries no gradient.

    Args:
        lens: S surfaces.
        rays: as launched, of a shape that broadcasts with (..., W, N).
        indices: (S + 1, W) refractive indices, as from `Lens.refractive_indices`.
        record: if given, the Rays behind every surface are appended to it, without gradient.

    Returns:
        The rays on the image plane, z = 0.
    """
    size = torch.broadcast_shapes(rays.x.shape, (indices.shape[1], 1))

    stack = (-1, *size[-2:])

    def batch(values: Tensor) -> Tensor:
        return values.expand(size).reshape(stack)

    start = (rays.fate, rays.lost_at, rays.x, rays.y, rays.z, rays.l, rays.m, rays.n, rays.path)
    start = [batch(v) for v in start]
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
    if record is not None:
        record[:] = [Rays(*(v.reshape(size) for v in vars(at).values())) for at in record]
    x, y, l, m, n, path, fate, lost_at = (v.reshape(size) for v in ends)
    return Rays(x, y, torch.zeros_like(x), l, m, n, path, fate, lost_at)
