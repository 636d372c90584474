"""A descent of a lens: step, validation, and the loop with progress, history, checkpoints and divergence.

The loss of a few images says little about a lens. So a descent ends with the lens of the smallest loss on a fixed set
of images, at the final pitch and full aperture.
"""

import math
import sys
from typing import Any

import torch
from torch import Tensor

from tasklens.design.objective import Objective
from tasklens.design.optimizers import LEEWAY_MM, OPTIMIZERS
from tasklens.design.problem import History
from tasklens.design.ray_space import as_saved
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields_full
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings

VALIDATIONS = 20  # validations of a descent, if its pixel pitch is constant
_PATIENCE = 3  # validations without a better lens
_ROWS = 100  # smallest number of rows of a history, if there are enough steps
_SHOWN = ("loss", "validation_loss", "energy_in_window", "penalty")  # numbers of a step in progress lines


def geometric(start: float, fraction: float) -> float:
    """Compute a scale that changes geometrically from `start` at fraction 0 to 1 at fraction 1, and then stays 1."""
    return start ** max(0.0, 1 - fraction)


class Diverged(Exception):
    """A step whose loss or change is not finite; the message names the field and the surface."""


class Descent:
    """One descent.

    If the criterion is trained, each validation compares the best lens with the current one by the current network.

    Args:
        start: starting lens.
        objective: criterion on the lens, with its images.
        design: numbers of rays and images per step.
        settings: settings of the descent.
        seed: seed of the rays and of the image order.

    Attributes:
        least: whether the best lens is far outside its limits, and its validation loss. A lens far outside is the best
            only if all are: its repair would change it much.
    """

    def __init__(
        self, start: Lens, objective: Objective, design: GradientDesignSettings, settings: DescentSettings, seed: int
    ):
        self.objective, self.settings, self.rays, self.seed = objective, settings, design.rays, seed
        self.optimizer = OPTIMIZERS[settings.optimizer](start, objective.problem, settings)
        self.best = self.optimizer.vector().detach()
        self.least = True, math.inf
        self.failures = 0  # validations since the best lens
        batch = settings.batch_size or design.batch_size
        self.images = self.order = None
        if objective.problem.dataset is not None:
            self.images = objective.batch_images()
            self.order = Shuffled(len(self.images), batch, torch.Generator().manual_seed(seed))

    def step(self, step: int) -> tuple[dict[str, float], Tensor]:
        """Take step number `step`, from 1, with its pixel pitch and stop.

        Returns:
            Numbers for the history, and the RMS spot radii (F,) of its lens [mm].

        Raises:
            Diverged: the loss or the change is not finite.
        """
        settings, objective, optimizer = self.settings, self.objective, self.optimizer
        indices = None if self.images is None or self.order is None else self.images[self.order.next()]
        fraction = (step - 1) / settings.steps
        first, last = settings.pixels
        pixels = last * geometric(first / last, fraction / settings.duration)
        stop = geometric(settings.stop_scale, fraction / settings.stop_duration)
        numbers: dict[str, float] = {}
        if pixels == last and stop == 1 and (step - 1) % max(1, settings.steps // VALIDATIONS) == 0:
            numbers["validation_loss"] = self._validate()
        vector = optimizer.vector()
        design = optimizer.lens(vector)
        (built_lens,) = objective.as_built(design, self.seed + step)
        lens, pupil = built_lens.with_stop_scaled(stop), sobol_disc(self.rays, self.seed + step)
        loss = objective.loss(lens, pupil, pixels, indices, self.seed + step, design)
        scaled_loss = loss.value / stop if objective.criterion.scales_with_stop else loss.value
        change = optimizer.change(vector, design, scaled_loss, fraction, pixels)
        if not (torch.isfinite(loss.fields).all() and torch.isfinite(change).all()):
            raise divergence(lens, loss.view, pupil, loss.fields)
        objective.criterion.train_step()
        numbers |= {"loss": loss.fields.mean().item(), "worst_field": loss.fields.max().item()}
        if loss.psfs is not None:
            numbers["energy_in_window"] = float(loss.psfs.detach().sum((-2, -1)).mean())
        numbers |= {"pixel_scale": pixels, "stop_scale": stop, **optimizer.numbers()}
        if math.isinf(self.least[1]):  # before the first validation the last finite lens is the best
            self.best = vector.detach().clone()
        optimizer.apply(change)
        if step == settings.steps:
            numbers["validation_loss"] = self._validate()
        return numbers, rms_spot_radius(loss.rays, centroid(loss.rays)).detach()

    def _validate(self) -> float:
        """Compute the loss of the current lens on the fixed images, and remember the lens if it is the best."""
        vector, violation = self.optimizer.vector().detach().clone(), self.optimizer.violation()
        far = not violation <= LEEWAY_MM  # also if it is not a number
        loss = self._validation_loss(vector, far)
        if self.objective.criterion.trained and math.isfinite(self.least[1]):
            self.least = self.least[0], self._validation_loss(self.best, self.least[0])
        score = far, loss
        if math.isfinite(loss + violation) and score <= self.least:  # a NaN lens has a finite loss
            self.least, self.best, self.failures = score, vector, 0
            return loss
        self.failures += 1
        if self.failures == _PATIENCE:
            self.failures = 0
            self.optimizer.go_back(self.best)
        return loss

    def _validation_loss(self, vector: Tensor, far: bool) -> float:
        """Compute the loss of a lens as it is saved: 0.01 mm beyond a limit can be worth more than a descent gains."""
        lens, problem = self.optimizer.lens(vector).detached(), self.objective.problem
        if not far:
            lens = as_saved(lens, problem.view, problem.limits, problem.free)
        return self.objective.validation_loss(lens, self.settings.pixels[1])

    def state(self) -> dict[str, Any]:
        """Return the best variables, and the count of validations."""
        return {name: getattr(self, name) for name in ("best", "least", "failures")}

    def result(self) -> dict[str, Any]:
        """Return the state after the last step and that of a trained network, for the test of the optimum."""
        network = self.objective.criterion.holders.get("network")
        return self.state() | ({} if network is None else {"network": network.state_dict()})

    def resume(self, state: dict[str, Any]) -> None:
        """Resume from `state`, or from `result`."""
        for name, value in state.items():
            if name == "network":
                self.objective.criterion.holders[name].load_state_dict(value)
            else:
                setattr(self, name, value)

    def lens(self) -> Lens:
        """Return the lens of the smallest validation loss; before the first validation, the last finite one."""
        return self.optimizer.lens(self.best).detached()


def run(descent: Descent, label: str, checkpoint: Checkpoint) -> tuple[Lens, History]:
    """Take all steps of a descent; if it diverges, stop with its best lens, and record that in the history.

    Args:
        label: label of progress lines, history and the part of the checkpoint.
        checkpoint: checkpoint of the job.

    Returns:
        The best lens, and a row per logged step: phase, step, the step's numbers, mean RMS spot [um].
    """
    steps = descent.settings.steps
    holders = {"optimizer": descent.optimizer, **descent.objective.criterion.holders}
    if descent.order is not None:
        holders["order"] = descent.order
    part = checkpoint.part(label, **holders)
    state = part.state if part.result is None else part.result
    if state is not None:
        descent.resume(state)
    if part.result is not None:
        return descent.lens(), part.history
    progress = Progress(label, steps)
    for step in range(part.step + 1, steps + 1):
        try:
            numbers, spots = descent.step(step)
        except Diverged as error:
            print(f"{label}: diverged at step {step}: {error}", file=sys.stderr, flush=True)
            part.history.append({"phase": f"{label}, diverged", "step": step, "cause": str(error)})
            break
        progress(step, **{name: numbers[name] for name in _SHOWN if name in numbers})
        if step % max(1, steps // _ROWS) == 0 or "validation_loss" in numbers:
            part.history.append({"phase": label, "step": step, **numbers, "rms_um": 1e3 * float(spots.mean())})
        part.save(step, **descent.state())
    part.finish(**descent.result())
    return descent.lens(), part.history


def divergence(lens: Lens, view: View, pupil: Tensor, losses: Tensor) -> Diverged:
    """Return an exception that names the first field and the first surface with values that are not finite.

    Args:
        lens: lens of the step.
        pupil: (N, 2) pupil points of its rays.
        losses: (F,) losses of the fields.
    """
    bad_fields = (~torch.isfinite(losses)).nonzero()[:, 0].tolist()
    field = "no field"
    if bad_fields:
        x, y = view.fields[bad_fields[0]].tolist()
        field = f"field {bad_fields[0]} at ({x:.3f}, {y:.3f}) mm"
    return Diverged(f"{field}; {_first_surface(lens.detached(), view, pupil)}")


def _first_surface(lens: Lens, view: View, pupil: Tensor) -> str:
    for i, numbers in enumerate(zip(lens.curvature, lens.thickness, lens.alpha, strict=True)):
        if not all(torch.isfinite(number).all() for number in numbers):
            return f"the shape of surface {i} is not finite"
    for i, rays in enumerate(trace_fields_full(lens, view, pupil)[1]):
        if any(not torch.isfinite(value[rays.lost_at < 0]).all() for value in (rays.x, rays.y, rays.l, rays.m, rays.n)):
            return f"rays become non-finite at surface {i}"
    return "all surfaces and rays are finite; the network or a limit is not"
