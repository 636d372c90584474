"""Imaging design by descent: the RMS spot radius, from flat plates, with an opening stop."""

import math
import sys

import torch

from tasklens.design.constraints import penalty
from tasklens.design.divergence import cause
from tasklens.design.schedule import cosine, geometric
from tasklens.design.start import Variables, parameter_groups
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.study.design_settings import SpotSettings
from tasklens.study.settings import Constraints


def design(
    start: Lens,
    view: View,
    limits: Constraints,
    settings: SpotSettings,
    seed: int,
    history: list[dict],
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Lens:
    """Minimise the mean over fields of sqrt(mean(r^2)) about the polychromatic centroid, with AdamW.

    Args:
        start: the lens to begin with.
        view: fields and colours, of equal weight.
        limits: held by a penalty.
        settings: steps, rates and the opening of the stop.
        seed: of the pupil points, which are redrawn at every step.
        history: receives a row per logged step.
        checkpoint: of the job, for its part `spot`.

    Returns:
        The lens with the least loss of all steps with the full stop: descents from plates jump into bad lenses now and
        then, and do not always come back. The last finite one if there is none.
    """
    variables = Variables.stepped(start, view, settings.learning_rates)
    values = {name: value.requires_grad_() for name, value in variables.values().items()}
    optimizer = torch.optim.AdamW(parameter_groups(values, settings.learning_rates), betas=(0.9, 0.99))
    rates = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: cosine(step / settings.steps, settings.learning_rates.final)
    )
    progress = Progress("spot", settings.steps)
    least, best = math.inf, variables.values()
    part = checkpoint.part("spot", history, optimizer=optimizer, learning_rates=rates)
    if part.state is not None:
        least, best = part.state["least"], part.state["best"]
        for name, value in values.items():
            value.data.copy_(part.state["values"][name])
    for step in range(part.step + 1, settings.steps + 1):
        lens = variables.assemble(values)
        scale = geometric(settings.stop_scale, (step - 1) / (settings.stop_duration * settings.steps))
        pupil = sobol_disc(settings.rays, seed * settings.steps + step)
        stopped = lens.with_stop_scaled(scale)
        rays = trace_fields(stopped, view, pupil)
        middle = centroid(rays)
        squared = (rays.x - middle[:, 0, None, None]) ** 2 + (rays.y - middle[:, 1, None, None]) ** 2
        spots = torch.where(rays.valid, squared, 1.0).mean((1, 2)).sqrt()  # a lost ray counts as 1 mm away
        spot = spots.mean()
        bounds = penalty(lens, limits, view)
        loss = spot / scale + settings.penalty * bounds
        if not torch.isfinite(loss):
            where = cause(stopped, view, pupil, spots)
            print(f"spot: diverged at step {step}: {where}", file=sys.stderr, flush=True)
            history.append({"step": step, "rms_um": math.inf, "cause": where})
            break
        if scale < 1 or loss.item() < least:
            best = {name: value.detach().clone() for name, value in values.items()}
            least = loss.item() if scale == 1 else math.inf
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        rates.step()
        rms_um = 1e3 * spot.item()
        progress(step, rms_um=rms_um, penalty=bounds.item())
        if step % max(1, settings.steps // 100) == 0:
            history.append({"step": step, "rms_um": rms_um, "penalty": bounds.item(), "rate": rates.get_last_lr()[0]})
        part.save(step, least=least, best=best, values=values)
    return variables.assemble(best).detached()
