"""Differentiable sequential ray tracing; every lost ray has a status and a surface."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy
import torch
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, launch
from tasklens.optics.tracing.traced import Inputs, Traced
from tasklens.runtime.first_derivative import FirstDerivative
from tasklens.runtime.tensors import explain_errors

_OUTPUTS = (0, 1, 3, 4, 5, 6)  # rows of the image without z, which is zero
_PARAMETERS = ("curvature", "conic", "thickness", "alpha")  # in the order of `Inputs`


class _Saved:
    """Non-differentiable inputs of a `_Trace`, and its result for `backward` and `jvp`."""

    def __init__(self, semi_diameter: Tensor, status: Tensor, lost_at: Tensor, record: bool):
        self.inputs = (semi_diameter, status, lost_at, record)
        self.traced: Traced


class _Trace(torch.autograd.Function):
    """Trace of `Inputs` to the image plane: x, y, l, m, n and path, each (..., W, N)."""

    @staticmethod
    def forward(notes, *inputs):
        notes.traced = Traced(Inputs(*inputs), *notes.inputs)
        return tuple(notes.traced.of_rays(notes.traced.image[k]) for k in _OUTPUTS)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.notes = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    @explain_errors
    def backward(ctx, *gradients):
        def reverse(*arguments):
            return ctx.notes.traced.reverse(arguments[: len(gradients)], _OUTPUTS, ctx.needs_input_grad[1:])

        return None, *FirstDerivative.apply(reverse, *gradients, *ctx.saved_tensors)

    @staticmethod
    def jvp(ctx, _, *changes):
        def change(*arguments):
            traced, along = ctx.notes.traced, arguments[: len(changes)]
            d_image, _ = traced.forward([None if v is None else v[None] for v in along])
            return tuple(traced.of_rays(d_image[0][row]) for row in _OUTPUTS)

        return FirstDerivative.apply(change, *changes, *ctx.saved_tensors)


def trace(lens: Lens, rays: Rays, indices: Tensor) -> Rays:
    """Trace rays through every surface of a lens to its image plane.

    Differentiable, in backward and forward mode, in the rays, the indices and every parameter of the lens except its
    apertures. A lost ray stays at its last point, with its direction along the axis; it carries no gradient.

    Args:
        lens: S surfaces.
        rays: launched rays, of a shape that broadcasts with (..., W, N).
        indices: (S + 1, W) refractive indices, as from `Lens.refractive_indices`.

    Returns:
        The rays on the image plane, z = 0.
    """
    return _trace_surfaces(lens, rays, indices, record=False)[0]


def trace_full(lens: Lens, rays: Rays, indices: Tensor) -> tuple[Rays, list[Rays]]:
    """Trace rays as `trace` does; return also the rays behind every surface, z from its vertex, without gradient."""
    image, traced = _trace_surfaces(lens, rays, indices, record=True)
    return image, _record(traced)


def _record(traced: Traced) -> list[Rays]:
    """Return the rays behind every surface, with their status there."""
    status, lost_at, launched = (traced.of_rays(v) for v in (traced.status, traced.lost_at, traced.launched))
    states = []
    for i, values in enumerate(traced.of_rays(traced.record).unbind()):
        later = launched & (lost_at > i)
        states.append(Rays(*values.unbind(), status.masked_fill(later, 0), lost_at.masked_fill(later, -1)))
    return states


def _trace_surfaces(lens: Lens, rays: Rays, indices: Tensor, record: bool) -> tuple[Rays, Traced]:
    size = numpy.broadcast_shapes(rays.x.shape, (indices.shape[1], 1))  # torch.broadcast_shapes takes 20 times as long
    components = (rays.x, rays.y, rays.z, rays.l, rays.m, rays.n, rays.path)
    start = torch.stack([v if v.shape == size else v.expand(size) for v in components]).to(lens.dtype)
    notes = _Saved(lens.semi_diameter, rays.status, rays.lost_at, record)
    x, y, l, m, n, path = _Trace.apply(notes, *_inputs(lens, start, indices))
    traced = notes.traced
    status, lost_at = traced.of_rays(traced.status), traced.of_rays(traced.lost_at)
    return Rays(x, y, torch.zeros_like(x), l, m, n, path, status, lost_at), traced


def _inputs(lens: Lens, start: Tensor, indices: Tensor) -> Inputs:
    shape = (lens.curvature, lens.conic, lens.thickness, lens.alpha)
    pose = (lens.pose.rotation, lens.pose.position) if lens.pose else (start.new_empty(0), start.new_empty(0))
    return Inputs(start, indices.to(lens.dtype), *shape, *pose)


def compile_tracer() -> None:
    """Compile the tracer for double precision, or load it from the cache on disk; not for single precision.

    Otherwise the first jobs of an installation would all compile it at the same time.
    """
    one = torch.ones(1, 1, dtype=torch.float64)
    lens = Lens(one[0].clone().requires_grad_(), one[0], one, one[0], one[0], (AIR,), stop=0)
    rays = launch(0.1 * one, 0 * one, 0 * one, 0 * one, 0 * one, one)
    indices = torch.ones(2, 1, dtype=torch.float64)
    trace(lens, rays, indices).x.sum().backward()
    linearise(lens, rays, indices).derivative({"curvature": one})


class Derivative(NamedTuple):
    """Changes of rays for V changes of a lens, (V, ..., W, N).

    Attributes:
        image: x, y, l, m and n of the rays on the image plane.
        behind: (V, S, 2, ..., W, N) x and y of the rays behind every surface.
    """

    image: tuple[Tensor, ...]
    behind: Tensor


class Linearised(NamedTuple):
    """Rays through a lens, and their derivative by the lens.

    Attributes:
        image: rays on the image plane.
        behind: rays behind every surface.
        derivative: takes V changes of the lens at once: `curvature`, `conic` and `thickness` (V, S), `alpha` (V, S, M);
            a missing one is zero. The launched rays do not change with the lens.
    """

    image: Rays
    behind: list[Rays]
    derivative: Callable[[Mapping[str, Tensor]], Derivative]


def linearise(lens: Lens, rays: Rays, indices: Tensor) -> Linearised:
    """Trace rays as `trace_full` does but without a graph, with the derivative along changes of the lens."""
    with torch.no_grad():
        image, traced = _trace_surfaces(lens.detached(), rays, indices, record=True)

    def derivative(changes: Mapping[str, Tensor]) -> Derivative:
        along = [changes.get(name) for name in _PARAMETERS]
        d_image, d_record = (traced.of_rays(v) for v in traced.forward([None, None, *along, None, None], record=True))
        x, y, _, l, m, n, _ = d_image.unbind(1)
        return Derivative((x, y, l, m, n), d_record)

    return Linearised(image, _record(traced), derivative)
