"""The loop of every design that goes step by step: progress, history, checkpoints, and what to do when it diverges.

A method is a `Descent`: it says what one step is. It never sees files, rows or steps that ran before it was killed.
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
_ROWS = 100  # of a history, at least, where there are that many steps
_SHOWN = ("loss", "energy_in_window", "penalty")  # of a step's numbers, in progress lines


@dataclass(frozen=True)
class Step:
    """What a step of a descent found: the rays of its lens, the losses (F,) of the fields, and numbers for its row."""

    rays: Rays
    losses: Tensor
    numbers: Mapping[str, float]


class Diverged(Exception):
    """A step whose loss or change is not finite; the message says in which field and at which surface."""


class Descent(ABC):
    """A method that changes a lens step by step; `state` is all that it has to remember between two steps.

    Attributes:
        steps: how many it takes.
        holders: parts of it that have `state_dict` and `load_state_dict`.
    """

    steps: int
    holders: Mapping[str, Any]

    @abstractmethod
    def step(self, step: int) -> Step:
        """Take the step of this number, from 1; raises Diverged and leaves the last finite lens."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """What the method is to remember after a step, beside `holders`."""

    @abstractmethod
    def resume(self, state: Mapping[str, Any]) -> None:
        """Become what `state` remembers."""

    @abstractmethod
    def lens(self) -> Lens:
        """The present result, out of every graph."""


def run(descent: Descent, label: str, checkpoint: Checkpoint) -> tuple[Lens, History]:
    """Take all steps of a descent; if it diverges, stop with its last finite lens, and say so in the history.

    Args:
        label: of progress lines, of the history and of the checkpoint's part.
        checkpoint: of the job.

    Returns:
        The lens at the end, and a row per logged step: phase, step, the step's numbers, mean RMS spot [um].
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
        if step % max(1, descent.steps // _ROWS) == 0:
            rms_um = 1e3 * float(rms_spot_radius(found.rays, centroid(found.rays)).mean().detach())
            part.history.append({"phase": label, "step": step, **found.numbers, "rms_um": rms_um})
        part.save(step, **descent.state())
    if part.result is None:
        part.finish(**descent.state())
    return descent.lens(), part.history


def divergence(lens: Lens, view: View, pupil: Tensor, losses: Tensor) -> Diverged:
    """The first field whose loss is not finite, and the first surface at which the lens or its rays are not.

    Args:
        lens: the lens of the step.
        pupil: (N, 2) its rays.
        losses: (F,) of the fields.
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
