"""Descent of a classifier's loss into a lens: captures, PSFs, rays, curvatures.

The gradient is taken in stages. The network runs in micro-batches of captures, each of which leaves dL/dcapture; then
one backward pass carries that through the convolutions to dL/dPSF, and one through the rays: captures are rendered and
rays traced once. This is exact while the network is in `eval()`; while it is trained with batch statistics, one
micro-batch per step makes it exact as well.
"""

import math
import sys
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.transforms.v2 import TrivialAugmentWide
from torchvision.transforms.v2.functional import resize

from tasklens.design.constraints import penalty
from tasklens.design.divergence import cause
from tasklens.design.schedule import cosine, geometric
from tasklens.design.start import Variables, parameter_groups
from tasklens.imaging import Camera
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.training import Shuffled
from tasklens.recognition.training import parameter_groups as network_groups
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.study.design_settings import JointDescentSettings
from tasklens.study.settings import CaptureSettings, Constraints


@dataclass(frozen=True)
class Problem:
    """What a descent is about, apart from the lens, the network and the settings.

    Attributes:
        view: fields, colours and pixels.
        limits: manufacturing limits, held by a penalty.
        capture: how images become captures.
        images: sharp training images.
        seed: of everything random.
    """

    view: View
    limits: Constraints
    capture: CaptureSettings
    dataset: ImageDataset
    seed: int


def sharp(dataset: ImageDataset, indices: Tensor, size: int | None) -> tuple[Tensor, Tensor]:
    """Images (B, 3, size, size) uint8 as a design sees them, of their own size without one, and their labels."""
    images = dataset.images[indices].to(dataset.device)
    return images if size is None else resize(images, [size, size]), dataset.labels[indices].to(dataset.device)


def loss_at_psf(
    classifier: nn.Module, images: Tensor, labels: Tensor, grid: Tensor, capture: CaptureSettings, micro_batch: int
) -> tuple[Tensor, Tensor]:
    """Mean cross-entropy over all captures, and its gradient at the PSFs.

    Network parameters that require a gradient accumulate theirs.

    Args:
        images: (B, 3, H, W) in [0, 1]; labels: (B,).
        grid: (F, 3, K, K) PSFs.
        micro_batch: the most of the F B captures that pass through the network at once.

    Returns:
        loss of each field (F,), whose mean is the loss, and its gradient dL/dPSF, on the device of `grid` and like it.
    """
    leaf = grid.detach().to(images).requires_grad_()
    captures = Camera(leaf, capture.outside_window, capture.colour).grid(images)
    seen, wanted = captures.detach().flatten(0, 1), labels.repeat(len(grid))
    parts = math.ceil(len(seen) / micro_batch)
    losses, gradients = [], []
    for part, label in zip(seen.chunk(parts), wanted.chunk(parts), strict=True):
        part.requires_grad_()
        loss = F.cross_entropy(classifier(part), label, reduction="none")
        (loss.sum() / len(seen)).backward()
        losses.append(loss.detach())
        gradients.append(part.grad)
    captures.backward(torch.cat(gradients).reshape(captures.shape))
    return torch.cat(losses).reshape(len(grid), -1).mean(-1).to(grid), leaf.grad.to(grid)


def descend(
    start: Lens,
    classifier: nn.Module,
    problem: Problem,
    settings: JointDescentSettings,
    history: list[dict],
    label: str,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Lens:
    """Minimise the classifier's loss over the lens and the network at once, with AdamW.

    PSFs are centred on the pinhole point, which holds the lens to its focal length and distortion.

    Args:
        start: the lens to begin with.
        classifier: trained in place, in `train()`; all captures of a step pass at once, for its batch statistics.
        problem: images, fields, limits.
        settings: steps, rates, cold start.
        history: receives a row per logged step.
        label: for progress lines and the history.
        checkpoint: of the job, for its part `label`.

    Returns:
        The lens after the last step; if the loss stops being finite, the last lens with a finite one, and the history
        says that the design diverged.
    """
    view, dataset = problem.view, problem.dataset
    cold, steps = settings.cold_start, settings.steps
    torch.manual_seed(problem.seed)  # TrivialAugment draws from torch's own generator
    generator = torch.Generator().manual_seed(problem.seed)
    variables = Variables.stepped(start, view, settings.learning_rates)
    values = {name: value.requires_grad_() for name, value in variables.values().items()}
    groups = parameter_groups(values, settings.learning_rates)
    classifier.train().requires_grad_(True)
    groups += [
        group | {"lr": settings.network_learning_rate} for group in network_groups(classifier, weight_decay=0.05)
    ]
    optimizer = torch.optim.AdamW(groups)
    rates = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: cosine(step / steps, settings.learning_rates.final)
    )
    augment = TrivialAugmentWide() if settings.augment else nn.Identity()
    captures = settings.images * len(view.fields)
    progress = Progress(label, steps)
    last = variables.values()
    order = Shuffled(len(dataset), settings.images, generator)
    part = checkpoint.part(label, history, network=classifier, optimizer=optimizer, learning_rates=rates, order=order)
    if part.state is not None:
        for name, value in values.items():
            value.data.copy_(part.state["values"][name])
        last = part.state["last"]
    for step in range(part.step + 1, steps + 1):
        indices = order.next()
        pixels = stop = 1.0
        if cold is not None:
            pixels = geometric(cold.pixel_scale, (step - 1) / (cold.pixel_duration * steps))
            stop = geometric(cold.stop_scale, (step - 1) / (cold.stop_duration * steps))
        lens = variables.assemble(values)
        pupil = sobol_disc(settings.rays, problem.seed * steps + step)
        stopped = lens.with_stop_scaled(stop)
        rays = trace_fields(stopped, view, pupil)
        grid = psf(rays, view.fields, view.pixel_pitch * pixels, view.kernel_size)
        bounds = penalty(lens, problem.limits, view)

        images, labels = sharp(dataset, indices, settings.size)
        images = torch.stack([augment(image) for image in images]).float() / 255
        optimizer.zero_grad()
        losses, gradient = loss_at_psf(classifier, images, labels, grid, problem.capture, captures)
        loss = losses.mean()
        total = loss + settings.penalty * bounds
        if not torch.isfinite(total):
            where = cause(stopped, view, pupil, losses)
            print(f"{label}: diverged at step {step}: {where}", file=sys.stderr, flush=True)
            history.append({"phase": f"{label}, diverged", "step": step, "cause": where})
            values = last
            break
        last = {name: value.detach().clone() for name, value in values.items()}
        torch.autograd.backward([grid, settings.penalty * bounds], [gradient, None])
        optimizer.step()
        rates.step()
        inside = grid.detach().sum((-2, -1)).mean().item()
        progress(step, loss=loss.item(), energy_in_window=inside, penalty=bounds.item())
        if step % max(1, steps // 100) == 0:
            rms = 1e3 * rms_spot_radius(rays, centroid(rays)).mean().item()
            history.append(
                {
                    "phase": label,
                    "step": step,
                    "loss": loss.item(),
                    "penalty": bounds.item(),
                    "energy_in_window": inside,
                    "rms_um": rms,
                    "pixel_scale": pixels,
                    "stop_scale": stop,
                    "rate": rates.get_last_lr()[0],
                }
            )
        part.save(step, values=values, last=last)
    classifier.eval().requires_grad_(False)
    return variables.assemble(values).detached()
