"""Task-driven design: the loss of a frozen classifier moves rays, and the rays move the lens.

Plain descent from flat plates ends in poor lenses, for two reasons. The parameters of a lens act on its rays in nearly
the same few ways, so that equal steps in each are very unequal on the sensor; and descents from the same plates end far
apart. So each step is measured in ray displacement (see `ray_space`), and several restarts start from the plates; the one
with the least loss goes on.
"""

import math
import sys

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.transforms.v2 import TrivialAugmentWide

from tasklens.design.divergence import cause
from tasklens.design.end_to_end import Problem, loss_at_psf, sharp
from tasklens.design.ray_space import LinearModel, RaySpace
from tasklens.design.schedule import cosine, geometric
from tasklens.imaging import Camera
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.recognition.classifiers import frozen
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.study.design_settings import RaySpaceSettings, TaskDrivenSettings

_LEEWAY = 0.05  # by which a step may lengthen the violation of the limits [mm]; a longer one is halved
_HALVINGS = 5  # at most
_JUDGES = 64  # images that compare the restarts


def design(
    start: Lens,
    classifier: nn.Module,
    problem: Problem,
    settings: TaskDrivenSettings,
    history: list[dict],
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Lens:
    """The lens at the end of the best descent from `start`; the classifier judges frozen and is not changed.

    Args:
        start: the lens to begin with.
        classifier: the well-trained classifier.
        problem: images, fields, limits, seed.
        settings: how many restarts, how they go, and how the best one goes on.
        history: receives a row per logged step and per judgement.
        checkpoint: of the job, for a part per descent.
    """
    classifier = frozen(classifier, settings.batch_norm)
    torch.manual_seed(problem.seed)  # TrivialAugment draws from torch's own generator
    seeds = torch.Generator().manual_seed(problem.seed)
    judged = torch.randperm(len(problem.dataset), generator=seeds)[:_JUDGES]
    found = []
    for walk in range(settings.starts):
        label = f"start {walk + 1} of {settings.starts}"
        lens = _walk(start, classifier, problem, settings, settings.start, seeds, history, label, checkpoint)
        loss = _judge(lens, classifier, problem, settings, judged)
        history.append({"phase": f"{label}, judged", "step": settings.start.steps, "loss": loss})
        found.append((loss, walk, lens))
    best = min(found, key=lambda entry: entry[:2])[2]
    return _walk(best, classifier, problem, settings, settings.refine, seeds, history, "refinement", checkpoint)


def _judge(lens: Lens, classifier: nn.Module, problem: Problem, settings: TaskDrivenSettings, judged: Tensor) -> float:
    """Mean loss of the judging images at the pixels with which a descent ends; infinite if it is not finite."""
    view = problem.view
    rays = trace_fields(lens, view, sobol_disc(settings.rays, problem.seed))
    grid = psf(rays, view.fields, view.pixel_pitch * settings.start.pixels[1], view.kernel_size)
    images, labels = sharp(problem.dataset, judged, settings.size)
    images = images.float() / 255
    with torch.no_grad():
        captures = Camera(grid.to(images), problem.capture.outside_window, problem.capture.colour).grid(images)
        # Every batch holds all fields, as those of a descent do: it matters to batch norms by the batch.
        seen, wanted = captures.transpose(0, 1).flatten(0, 1), labels.repeat_interleave(len(grid))
        parts = zip(seen.split(settings.micro_batch), wanted.split(settings.micro_batch), strict=True)
        loss = sum(float(F.cross_entropy(classifier(part), label, reduction="sum")) for part, label in parts)
        loss /= len(seen)
    return loss if math.isfinite(loss) else math.inf


def _walk(
    start: Lens,
    classifier: nn.Module,
    problem: Problem,
    settings: TaskDrivenSettings,
    walk: RaySpaceSettings,
    seeds: torch.Generator,
    history: list[dict],
    label: str,
    checkpoint: Checkpoint,
) -> Lens:
    """The lens after the steps of `descent`; if the loss or a step stops being finite, the last finite one."""
    view, dataset = problem.view, problem.dataset
    space = RaySpace(start, view, problem.limits)
    vector = space.start
    mean, finite, local = torch.zeros_like(vector), vector, space.linearise(vector)
    augment = TrivialAugmentWide() if settings.augment else nn.Identity()
    seed = int(torch.randint(2**31, (), generator=seeds))
    order = Shuffled(len(dataset), settings.images, torch.Generator().manual_seed(seed))
    progress = Progress(label, walk.steps)
    part = checkpoint.part(label, history, order=order)
    if part.result is not None:
        return space.lens(part.result["vector"])
    if part.state is not None:
        vector, mean, finite = (part.state[name] for name in ("vector", "mean", "finite"))
        local = space.linearise(vector)
    for step in range(part.step + 1, walk.steps + 1):
        indices = order.next()
        done = (step - 1) / walk.steps
        first, last = walk.pixels
        pixels = last * geometric(first / last, done / walk.duration)
        step_size = walk.step_size * view.pixel_pitch * pixels
        if done > walk.duration:
            step_size *= cosine((done - walk.duration) / (1 - walk.duration), walk.final)
        leaf = vector.clone().requires_grad_()
        lens = space.lens(leaf)
        pupil = sobol_disc(settings.rays, seed + step)
        rays = trace_fields(lens, view, pupil)
        grid = psf(rays, view.fields, view.pixel_pitch * pixels, view.kernel_size)
        images, labels = sharp(dataset, indices, settings.size)
        images = torch.stack([augment(image) for image in images]).float() / 255
        losses, upstream = loss_at_psf(classifier, images, labels, grid, problem.capture, settings.micro_batch)
        grid.backward(upstream)
        mean = walk.momentum * mean + (1 - walk.momentum) * leaf.grad
        gradient = mean / (1 - walk.momentum**step)
        change = local.step(gradient, step_size, walk.damping)
        if not (torch.isfinite(losses).all() and torch.isfinite(change).all()):
            where = cause(lens, view, pupil, losses)
            print(f"{label}: diverged at step {step}: {where}", file=sys.stderr, flush=True)
            history.append({"phase": f"{label}, diverged", "step": step, "cause": where})
            vector = finite
            break
        inside = grid.detach().sum((-2, -1)).mean().item()
        progress(step, loss=losses.mean().item(), energy_in_window=inside)
        if step % max(1, walk.steps // 50) == 0:
            row = {"phase": label, "step": step, "loss": losses.mean().item(), "worst_field": losses.max().item()}
            rms = 1e3 * rms_spot_radius(rays, centroid(rays)).mean().item()
            row |= {"energy_in_window": inside, "rms_um": rms, "pixel_scale": pixels, "stride_um": step_size}
            history.append(row | {"violation": local.broken})
        finite = vector
        vector, local = _advance(space, vector, change, local.broken)
        part.save(step, vector=vector, mean=mean, finite=finite)
    part.finish(vector=vector)
    return space.lens(vector)


def _advance(space: RaySpace, vector: Tensor, change: Tensor, broken: float) -> tuple[Tensor, LinearModel]:
    """The variables after `change`, and what is about them; after a part of it where it breaks limits far more."""
    for halvings in range(_HALVINGS + 1):
        moved = vector + change / 2**halvings
        local = space.linearise(moved)
        if local.broken <= broken + _LEEWAY:
            break
    return moved, local
