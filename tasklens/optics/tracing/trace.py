"""Differentiable sequential ray tracing; every lost ray has a status and a surface."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy
import torch
from torch import Tensor

from tasklens.optics.lens import Lens
from tasklens.optics.rays import RIM, Rays
from tasklens.optics.tracing import kernel
from tasklens.optics.tracing.kernel import GROUP

_PARAMETERS = ("curvature", "conic", "thickness", "alpha")  # in the order of `_Inputs`


class _Inputs(NamedTuple):
    """What a trace can be differentiated by: rays (7, ..., W, N), indices (S + 1, W), and tensors of the lens."""

    start: Tensor
    indices: Tensor
    curvature: Tensor
    conic: Tensor
    thickness: Tensor
    alpha: Tensor
    rotation: Tensor  # (S, 3, 3) and (S, 3) of surfaces with a pose; of no surface where none has one
    position: Tensor


class _Traced:
    """Rays traced through a lens, and the derivatives of it: numpy arrays, as the kernel wants them."""

    def __init__(self, inputs: _Inputs, semi_diameter: Tensor, status: Tensor, lost_at: Tensor, record: bool):
        self.shape = inputs.start.shape[1:]
        self.start = inputs.start.detach().contiguous().numpy().reshape(7, -1)
        self.lens = _tables(inputs, semi_diameter)
        self.orders = inputs.alpha.shape[1]
        self.status, self.lost_at = (v.expand(self.shape).flatten().numpy().copy() for v in (status, lost_at))
        self.launched = self.status == 0
        surfaces, rays = len(semi_diameter), self.start.shape[1]
        self.image, self.distances = self.array(7, rays), self.array(surfaces, rays)
        self.record = self.array(surfaces if record else 0, 7, rays)
        self.start_of = (self.start, tuple(self.shape[-2:]), self.lens)
        outputs = (self.image, self.status, self.lost_at, self.distances, self.record)
        _in_parts(rays, lambda *part: kernel.trace(*part, *self.start_of, *outputs))

    def array(self, *shape: int) -> numpy.ndarray:
        """Return an empty array of the rays' data type."""
        return numpy.empty(shape, self.start.dtype)

    def of_rays(self, values: numpy.ndarray) -> Tensor:
        """Return values (..., R) as a tensor of the rays' shape."""
        return torch.from_numpy(values).reshape(*values.shape[:-1], *self.shape)

    def reverse(self, gradient: Tensor, wanted: Sequence[bool]) -> list[Tensor | None]:
        """Compute the gradients of the wanted `_Inputs` from that of the image, (7, ..., W, N)."""
        surfaces, rays = self.distances.shape
        groups = -(-rays // GROUP)
        to_rays, to_indices, to_poses = wanted[0], wanted[1], any(wanted[6:]) or self.lens[3].any()
        b_start = self.array(7 if to_rays else 0, rays)
        b_lens = numpy.zeros((groups, surfaces, 3 + self.orders))
        b_indices = numpy.zeros((groups, surfaces + 1 if to_indices else 0, self.shape[-2]))
        b_poses = numpy.zeros((groups, surfaces if to_poses else 0, 4, 3))
        b_image = gradient.contiguous().numpy().reshape(7, -1)
        known = (*self.start_of, self.status, self.distances, b_image, b_start, b_lens, b_indices, b_poses)
        _in_parts(rays, lambda *part: kernel.reverse(*part, *known))
        b_lens, b_poses = b_lens.sum(0), b_poses.sum(0)
        found = (
            b_start.reshape(-1, *self.shape),
            b_indices.sum(0),
            *(b_lens[:, k] for k in range(3)),
            b_lens[:, 3:],
            b_poses[:, :3],
            b_poses[:, 3],
        )
        return [torch.from_numpy(v).to(gradient.dtype) if want else None for v, want in zip(found, wanted, strict=True)]

    def forward(self, changes: Sequence[Tensor | None], record: bool = False) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Compute the changes of the image, (V, 7, R), for V changes of each of the `_Inputs`, where None is no change.

        Returns:
            those, and with `record` those of x and y behind every surface, (V, S, 2, R).
        """
        surfaces, rays = self.distances.shape
        count = next(len(v) for v in changes if v is not None)
        d_start, d_indices, *d_lens, d_alpha, d_rotation, d_position = changes
        d_rotation, d_position = (None if v is None or not v.numel() else v for v in (d_rotation, d_position))
        moves = d_rotation is not None or d_position is not None
        table = self.array(count, surfaces, 3 + 2 * self.lens[1].shape[2])
        table[:] = 0
        for k, values in enumerate(d_lens):
            if values is not None:
                table[..., k] = values.numpy()
        if d_alpha is not None:
            padded = self.lens[1].shape[2]
            table[..., 3 : 3 + self.orders] = d_alpha.numpy()
            table[..., 3 + padded : 3 + padded + self.orders] = d_alpha.numpy() * numpy.arange(1, self.orders + 1)
        poses = numpy.zeros((count if moves else 0, surfaces, 4, 3), table.dtype)
        if d_rotation is not None:
            poses[:, :, :3] = d_rotation.numpy()
        if d_position is not None:
            poses[:, :, 3] = d_position.numpy()
        begins = numpy.zeros(count, numpy.int64)
        if d_start is None and d_indices is None and not moves:
            begins[:] = (table != 0).any(2).argmax(1)
        none = self.array(0, 0, 0)
        d_rays = none if d_start is None else d_start.contiguous().numpy().reshape(count, 7, -1)
        d_media = none if d_indices is None else d_indices.contiguous().numpy()
        d_image = self.array(count, 7, rays)
        d_record = numpy.zeros((count if record else 0, surfaces, 2, rays), table.dtype)
        lost = (self.status, self.lost_at)
        known = (*self.start_of, *lost, self.distances, begins, d_rays, table, d_media, poses)
        _in_parts(rays, lambda *part: kernel.forward(*part, *known, d_image, d_record))
        return d_image, d_record

    def image_change(self, changes: Sequence[Tensor | None]) -> Tensor:
        """Compute the change of the image, (7, ..., W, N), for one change of the `_Inputs`."""
        return self.of_rays(self.forward([None if v is None else v[None] for v in changes])[0][0])


class _Notes:
    """Inputs of a `_Trace` that have no derivative, and what it leaves for the derivatives of the others."""

    def __init__(self, semi_diameter: Tensor, status: Tensor, lost_at: Tensor, record: bool):
        self.inputs = (semi_diameter, status, lost_at, record)
        self.traced: _Traced


class _Call(torch.autograd.Function):
    """Call a function of tensors: `torch.func` wraps the arguments of derivatives, but not those of a Function."""

    @staticmethod
    def forward(function, *arguments):
        found = function(*arguments)
        return tuple(found) if isinstance(found, list) else found

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass


class _Trace(torch.autograd.Function):
    """Trace of `_Inputs` to the image plane: x, y, z, l, m, n and path (7, ..., W, N)."""

    @staticmethod
    def forward(notes, *inputs):
        notes.traced = _Traced(_Inputs(*inputs), *notes.inputs)
        return notes.traced.of_rays(notes.traced.image)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.notes = inputs[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        return None, *_Call.apply(lambda g: ctx.notes.traced.reverse(g, ctx.needs_input_grad[1:]), gradient)

    @staticmethod
    def jvp(ctx, _, *changes):
        return _Call.apply(lambda *along: ctx.notes.traced.image_change(along), *changes)


def _tables(inputs: _Inputs, semi_diameter: Tensor) -> tuple[numpy.ndarray, ...]:
    """Return the tables of a lens for the kernel: surfaces, polynomials, indices, which are posed, and poses."""
    dtype = inputs.start.detach().numpy().dtype
    curvature, conic, thickness, alpha = (v.detach().numpy() for v in inputs[2:6])
    surfaces = numpy.empty((len(curvature), kernel.COLUMNS), dtype)
    surfaces[:, kernel.CURVATURE], surfaces[:, kernel.THICKNESS] = curvature, thickness
    surfaces[:, kernel.BENDING] = (1 + conic) * curvature * curvature
    limit = numpy.float64(semi_diameter.detach().numpy()) ** 2 * (1 + RIM)
    surfaces[:, kernel.LIMIT] = numpy.minimum(limit, numpy.finfo(dtype).max)
    orders = alpha.shape[1]
    polynomials = numpy.zeros((len(curvature), 3, -(-orders // kernel.CHUNK) * kernel.CHUNK), dtype)
    j = numpy.arange(1, orders + 1, dtype=dtype)
    polynomials[:, kernel.VALUES, :orders] = alpha
    polynomials[:, kernel.SLOPES, :orders] = j * alpha
    polynomials[:, kernel.CURVINGS, : max(0, orders - 1)] = ((j - 1) * j * alpha)[:, 1:]
    kernel.gentle_radii(surfaces, polynomials)
    rotations = numpy.zeros((len(curvature), 3, 3), dtype) + numpy.eye(3, dtype=dtype)
    positions = numpy.zeros((len(curvature), 3), dtype)
    if len(inputs.rotation):
        rotations[:], positions[:] = inputs.rotation.detach().numpy(), inputs.position.detach().numpy()
    posed = numpy.full(len(curvature), len(inputs.rotation) > 0)
    return surfaces, polynomials, inputs.indices.detach().contiguous().numpy(), posed, rotations, positions


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(torch.get_num_threads())


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


def _in_parts(rays: int, work: Callable[[int, int], None]) -> None:
    """Call work(first, last) on groups of rays, in as many threads as torch uses; rays do not know of each other."""
    threads = min(torch.get_num_threads(), rays // GROUP)
    if threads <= 1:
        work(0, rays)
        return
    groups = -(-rays // GROUP)
    ends = [min(rays, k * groups // threads * GROUP) for k in range(threads + 1)]
    ends[-1] = rays
    list(_pool().map(work, ends[:-1], ends[1:]))


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
    return _traced(lens, rays, indices, record=False)[0]


def trace_full(lens: Lens, rays: Rays, indices: Tensor) -> tuple[Rays, list[Rays]]:
    """Trace rays as `trace` does; return also the rays behind every surface, z from its vertex, without gradient."""
    image, traced = _traced(lens, rays, indices, record=True)
    return image, _recorded(traced)


def _recorded(traced: _Traced) -> list[Rays]:
    """Return the rays behind every surface, with their status there."""
    status, lost_at, launched = (traced.of_rays(v) for v in (traced.status, traced.lost_at, traced.launched))
    behind = []
    for i, values in enumerate(traced.of_rays(traced.record).unbind()):
        later = launched & (lost_at > i)
        behind.append(Rays(*values.unbind(), status.masked_fill(later, 0), lost_at.masked_fill(later, -1)))
    return behind


def _traced(lens: Lens, rays: Rays, indices: Tensor, record: bool) -> tuple[Rays, _Traced]:
    dtype = lens.dtype
    size = numpy.broadcast_shapes(rays.x.shape, (indices.shape[1], 1))  # of torch it takes 20 times as long
    start = torch.stack([v.expand(size).to(dtype) for v in (rays.x, rays.y, rays.z, rays.l, rays.m, rays.n, rays.path)])
    notes = _Notes(lens.semi_diameter, rays.status, rays.lost_at, record)
    image = _Trace.apply(notes, *_inputs(lens, start, indices))
    x, y, _, l, m, n, path = image.unbind()
    traced = notes.traced
    status, lost_at = traced.of_rays(traced.status), traced.of_rays(traced.lost_at)
    return Rays(x, y, torch.zeros_like(x), l, m, n, path, status, lost_at), traced


def _inputs(lens: Lens, start: Tensor, indices: Tensor) -> _Inputs:
    shape = (lens.curvature, lens.conic, lens.thickness, lens.alpha)
    pose = (lens.pose.rotation, lens.pose.position) if lens.pose else (start.new_empty(0), start.new_empty(0))
    return _Inputs(start, indices.to(lens.dtype), *shape, *pose)


class Derivative(NamedTuple):
    """Changes of rays for V changes of a lens, (V, ..., W, N).

    Attributes:
        image: x, y, l, m and n of the rays on the image plane.
        behind: of x and y of the rays behind every surface.
    """

    image: tuple[Tensor, ...]
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
    """Trace rays as `trace_full` does but without a graph, with the derivative along changes of the lens."""
    with torch.no_grad():
        image, traced = _traced(lens.detached(), rays, indices, record=True)

    def derivative(changes: Mapping[str, Tensor]) -> Derivative:
        along = [changes.get(name) for name in _PARAMETERS]
        d_image, d_record = (traced.of_rays(v) for v in traced.forward([None, None, *along, None, None], record=True))
        x, y, _, l, m, n, _ = d_image.unbind(1)
        return Derivative((x, y, l, m, n), [d.unbind(1) for d in d_record.unbind(1)])

    return Linearised(image, _recorded(traced), derivative)
