"""Rays traced through a lens, and their derivatives: tensor and thread interface of the compiled tracer."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy
import torch
from torch import Tensor

from tasklens.optics.rays import RIM
from tasklens.optics.tracing import block, derivatives, kernel
from tasklens.optics.tracing.block import GROUP
from tasklens.optics.tracing.crossing import prepare


class Inputs(NamedTuple):
    """Tensors by which a trace is differentiable: rays (7, ..., W, N), indices (S + 1, W), and tensors of the lens."""

    start: Tensor
    indices: Tensor
    curvature: Tensor
    conic: Tensor
    thickness: Tensor
    alpha: Tensor
    rotation: Tensor  # (S, 3, 3) and position (S, 3); both are empty for a lens without poses
    position: Tensor


class Traced:
    """Rays traced through a lens, and their derivatives, as numpy arrays for the kernel."""

    def __init__(self, inputs: Inputs, semi_diameter: Tensor, status: Tensor, lost_at: Tensor, record: bool):
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

    def reverse(
        self, gradients: Sequence[Tensor | None], rows: Sequence[int], needs: Sequence[bool]
    ) -> list[Tensor | None]:
        """Compute gradients of the `Inputs` that `needs` selects from those of image rows (..., W, N); None is zero."""
        surfaces, rays = self.distances.shape
        groups = -(-rays // GROUP)
        to_rays, to_indices, to_poses = needs[0], needs[1], any(needs[6:]) or self.lens[3].any()
        b_start = self.array(7 if to_rays else 0, rays)
        b_lens = numpy.zeros((groups, surfaces, 3 + self.orders))
        b_indices = numpy.zeros((groups, surfaces + 1 if to_indices else 0, self.shape[-2]))
        b_poses = numpy.zeros((groups, surfaces if to_poses else 0, 4, 3))
        b_image = numpy.zeros((7, rays), self.start.dtype)
        for row, gradient in zip(rows, gradients, strict=True):
            if gradient is not None:
                b_image[row].reshape(self.shape)[:] = gradient.numpy()
        arguments = (*self.start_of, self.status, self.distances, b_image, b_start, b_lens, b_indices, b_poses)
        _in_parts(rays, lambda *part: derivatives.reverse(*part, *arguments))
        dtype = self.start.dtype
        lens, poses = b_lens.sum(0).astype(dtype), b_poses.sum(0).astype(dtype)
        by_input = (
            lambda: b_start.reshape(-1, *self.shape),
            lambda: b_indices.sum(0).astype(dtype),
            *(lambda k=k: lens[:, k] for k in range(3)),
            lambda: lens[:, 3:],
            lambda: poses[:, :3],
            lambda: poses[:, 3],
        )
        return [torch.from_numpy(compute()) if need else None for compute, need in zip(by_input, needs, strict=True)]

    def forward(self, changes: Sequence[Tensor | None], record: bool = False) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Compute the changes of the image, (V, 7, R), for V changes of each of the `Inputs`; None is no change.

        Returns:
            The changes of the image; with `record` also those of x and y behind every surface, (V, S, 2, R).
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
        arguments = (*self.start_of, *lost, self.distances, (begins, d_rays, table, d_media, poses))
        _in_parts(rays, lambda *part: derivatives.forward(*part, *arguments, d_image, d_record))
        return d_image, d_record


def _tables(inputs: Inputs, semi_diameter: Tensor) -> tuple[numpy.ndarray, ...]:
    """Return the tables of a lens for the kernel: surfaces, polynomials, indices, which are posed, poses."""
    values = [v.detach().contiguous().numpy() for v in inputs]
    dtype, (count, orders) = values[0].dtype, inputs.alpha.shape
    surfaces = numpy.empty((count, block.COLUMNS), dtype)
    polynomials = numpy.zeros((count, 3, -(-orders // block.CHUNK) * block.CHUNK), dtype)
    limit = numpy.float64(semi_diameter.detach().numpy()) ** 2 * (1 + RIM)
    prepare(*values[2:6], numpy.minimum(limit, numpy.finfo(dtype).max), surfaces, polynomials)
    posed = numpy.full(count, len(values[6]) > 0)
    rotations, positions = (
        values[6:] if posed[0] else (numpy.zeros((count, 3, 3), dtype), numpy.zeros((count, 3), dtype))
    )
    return surfaces, polynomials, values[1], posed, rotations, positions


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(torch.get_num_threads())


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


def _in_parts(rays: int, work: Callable[[int, int], None]) -> None:
    """Call work(first, last) on groups of rays, in as many threads as torch uses; rays are independent."""
    threads = min(torch.get_num_threads(), rays // GROUP)
    if threads <= 1:
        work(0, rays)
        return
    groups = -(-rays // GROUP)
    ends = [min(rays, k * groups // threads * GROUP) for k in range(threads + 1)]
    ends[-1] = rays
    list(_pool().map(work, ends[:-1], ends[1:]))
