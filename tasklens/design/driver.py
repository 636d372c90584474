"""The common loop of iterative designs: progress, history, checkpoints and divergence.

A method is a `Descent`, which implements one step.
"""

import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields_full
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.progress import Progress

History = list[dict[str, Any]]
_ROWS = 100  # least number of rows of a history, if there are as many steps
_SHOWN = ("loss", "validation_loss", "energy_in_window", "penalty")  # numbers of a step in progress lines


@dataclass(frozen=True)
class Step:
    """Result of a step: the rays of its lens, and numbers for the history."""

    rays: Rays
    numbers: Mapping[str, float]


class Diverged(Exception):
    """A step whose loss or change is not finite; the message names the field and the surface."""


class Descent(ABC):
    """An iterative design method.

    Attributes:
        steps: number of steps.
        holders: parts with `state_dict` and `load_state_dict`, by name, saved in addition to `state`.
    """

    steps: int
    holders: Mapping[str, Any]

    @abstractmethod
    def step(self, step: int) -> Step:
        """Take step number `step`, from 1; raises Diverged and restores the last finite lens."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return the state after a step, without `holders`."""

    @abstractmethod
    def resume(self, state: Mapping[str, Any]) -> None:
        """Resume from `state`."""

    @abstractmethod
    def lens(self) -> Lens:
        """Return the present result, detached from autograd."""


def run(descent: Descent, label: str, checkpoint: Checkpoint) -> tuple[Lens, History]:
    """Take all steps of a descent; if it diverges, stop with its last finite lens, and record that in the history.

    Args:
        label: label of progress lines, history and the part of the checkpoint.
        checkpoint: checkpoint of the job.

    Returns:
        The final lens, and a row per logged step: phase, step, the step's numbers, mean RMS spot [um].
    """
    part = checkpoint.part(label, **descent.holders)
    known = part.state if part.result is None else part.result
    if known is not None:
        descent.resume(known)
    progress = Progress(label, descent.steps)
    done = descent.steps if part.result is not None else part.step
    for step in range(done + 1, descent.steps + 1):
        try:
            found = descent.step(step)
        except Diverged as error:
            print(f"{label}: diverged at step {step}: {error}", file=sys.stderr, flush=True)
            part.history.append({"phase": f"{label}, diverged", "step": step, "cause": str(error)})
            break
        progress(step, **{name: found.numbers[name] for name in _SHOWN if name in found.numbers})
        if step % max(1, descent.steps // _ROWS) == 0 or "validation_loss" in found.numbers:
            rms_um = 1e3 * float(rms_spot_radius(found.rays, centroid(found.rays)).mean().detach())
            part.history.append({"phase": label, "step": step, **found.numbers, "rms_um": rms_um})
        part.save(step, **descent.state())
    if part.result is None:
        part.finish(**descent.state())
    return descent.lens(), part.history


def divergence(lens: Lens, view: View, pupil: Tensor, losses: Tensor) -> Diverged:
    """Return an exception that names the first field whose loss, and the first surface whose values are not finite.

    Args:
        lens: lens of the step.
        pupil: (N, 2) pupil points of its rays.
        losses: (F,) losses of the fields.
    """
    wrong = (~torch.isfinite(losses)).nonzero()[:, 0].tolist()
    field = "no field"
    if wrong:
        x, y = view.fields[wrong[0]].tolist()
        field = f"field {wrong[0]} at ({x:.3f}, {y:.3f}) mm"
    return Diverged(f"{field}; {_first_surface(lens.detached(), view, pupil)}")


def _first_surface(lens: Lens, view: View, pupil: Tensor) -> str:
    for i, numbers in enumerate(zip(lens.curvature, lens.thickness, lens.alpha, strict=True)):
        if not all(torch.isfinite(number).all() for number in numbers):
            return f"surface {i} has a shape that is not finite"
    for i, rays in enumerate(trace_fields_full(lens, view, pupil)[1]):
        if any(not torch.isfinite(value[rays.lost_at < 0]).all() for value in (rays.x, rays.y, rays.l, rays.m, rays.n)):
            return f"rays stop being finite at surface {i}"
    return "all surfaces and rays are finite, the network or a limit is not"
