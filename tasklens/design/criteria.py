"""Criteria of a design: a loss of captures, of PSFs or of rays, and the loss of a network.

For captures the gradient is computed in stages. The criterion, with its network if it has one, runs in micro-batches of
captures, and each gives dL/dcapture. Then one backward pass through the convolutions gives dL/dPSF, and one more passes
through the rays, so that captures are rendered and rays traced once. This is exact for a network in `eval()`; with
batch statistics, it is exact for one micro-batch per step.
"""

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from tasklens.camera.imaging import PsfCamera
from tasklens.design.objective import VALIDATION_RAYS, Batch, Criterion, Loss, Objective
from tasklens.design.optimizers import cosine
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.recognition.tasks import CLASSIFICATION, Task
from tasklens.recognition.training import parameter_groups
from tasklens.settings.capture_settings import CaptureSettings

_WEIGHT_DECAY = 0.05  # for a network that is trained with a lens


def loss_at_psf(
    criterion: "CaptureCriterion",
    images: Tensor,
    labels: Tensor,
    grid: Tensor,
    capture: CaptureSettings,
    micro_batch: int,
    illumination: Tensor | None = None,
    seed: int = 0,
    weights: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the mean loss over all captures, and its gradient at the PSFs.

    Network parameters that require a gradient accumulate theirs.

    Args:
        images: (B, 3, H, W) sharp images in [0, 1].
        labels: (B,) labels.
        grid: (F, 3, K, K) PSFs.
        micro_batch: maximum number of the F B captures that the criterion takes at once.
        illumination: (F,) relative illumination, if there is a sensor.
        seed: seed of the noise.
        weights: (F,) weights of the fields, with mean 1; None: equal weights.

    Returns:
        Weighted loss of each field (F,), whose mean is L; and dL/dPSF, of the shape of `grid`. Both have its device and
        dtype.
    """
    leaf = grid.detach().to(images).requires_grad_()
    camera = PsfCamera.of(capture, leaf, illumination)
    captures = camera.all_fields(images, torch.Generator().manual_seed(seed))
    inputs, source = captures.detach().flatten(0, 1), torch.arange(len(images)).repeat(len(grid))
    count = math.ceil(len(inputs) / micro_batch)
    weight = (torch.ones(len(grid)) if weights is None else weights).to(images).repeat_interleave(len(images))
    losses, gradients = [], []
    parts = (values.chunk(count) for values in (inputs, source, weight))
    for batch, rows, factors in zip(*parts, strict=True):
        batch.requires_grad_()
        loss = factors * criterion.losses(batch, images[rows], labels[rows])
        (loss.sum() / len(inputs)).backward()
        losses.append(loss.detach())
        assert batch.grad is not None
        gradients.append(batch.grad)
    (at_psf,) = torch.autograd.grad(captures, leaf, torch.cat(gradients).reshape(captures.shape))
    return torch.cat(losses).reshape(len(grid), -1).mean(-1).to(grid), at_psf.to(grid)


class CaptureCriterion(Criterion):
    """A loss of each capture."""

    reads_images = True

    @abstractmethod
    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,) of each capture (N, 3, H, W) of sharp images (N, 3, H, W) with labels (N,)."""

    def loss(
        self, objective: Objective, lens: Lens, view: View, pupil: Tensor, pixels: float, batch: Batch | None = None
    ) -> Loss:
        """Compute the loss of captures of images, in stages."""
        assert batch is not None
        rays, grid = objective.trace(lens, view, pupil, pixels)
        images, labels = objective.images(batch.indices, objective.augment)
        light, weights = objective.illumination(batch.design, view), objective.weights(view)
        settings = objective.capture, objective.micro_batch, light, batch.seed, weights
        losses, gradient = loss_at_psf(self, images, labels, grid, *settings)
        return Loss(rays, view, losses, (grid * gradient).sum(), grid)

    def fixed_losses(
        self, objective: Objective, lens: Lens, lights: Sequence[Tensor | None], pixels: float, part: slice
    ) -> Tensor:
        """Compute the losses (N,) of images that take the views of the validation in turns, without augmentation."""
        views, indices = objective.problem.views_of_validation, objective.fixed_images(part)
        noise = torch.Generator().manual_seed(objective.problem.seed)  # drawn by image, so independent of micro-batches
        losses = torch.empty(len(indices))
        for turn, (view, light) in enumerate(zip(views[: len(indices)], lights, strict=False)):
            images, labels = objective.images(indices[turn :: len(views)], augment=False)
            _, grid = objective.trace(lens, view, sobol_disc(VALIDATION_RAYS, seed=0), pixels)
            camera = PsfCamera.of(objective.capture, grid.to(images), light)
            weights = objective.weights(view).to(images)
            # Micro-batches hold all fields of an image: batch norms in batch mode need them in every batch.
            batch_size = max(1, objective.micro_batch // len(grid))
            of_turn = []
            with self.evaluating():
                for batch, batch_labels in zip(images.split(batch_size), labels.split(batch_size), strict=True):
                    captures = camera.all_fields(batch, noise)
                    sharp, targets = (torch.cat([values] * len(grid)) for values in (batch, batch_labels))
                    of_batch = self.losses(captures.flatten(0, 1), sharp, targets).reshape(len(grid), -1)
                    of_turn.append((weights[:, None] * of_batch).mean(0))
            losses[turn :: len(views)] = torch.cat(of_turn).to(losses)
        return losses


class FieldCriterion(Criterion):
    """A loss of each field, without images.

    Attributes:
        by_psf: whether it is a loss of PSFs, not of rays alone.
    """

    by_psf = True

    @abstractmethod
    def of_fields(self, rays: Rays, grid: Tensor | None, view: View) -> Tensor:
        """Compute the loss (F,) of a lens at the fields of a view: of its rays, or, if `by_psf`, PSFs (F, W, K, K)."""

    def loss(
        self, objective: Objective, lens: Lens, view: View, pupil: Tensor, pixels: float, batch: Batch | None = None
    ) -> Loss:
        """Compute the loss of rays or PSFs."""
        rays, grid = (
            objective.trace(lens, view, pupil, pixels) if self.by_psf else (trace_fields(lens, view, pupil), None)
        )
        losses = objective.weights(view) * self.of_fields(rays, grid, view)
        return Loss(rays, view, losses.detach(), losses.mean(), grid)

    def fixed_losses(
        self, objective: Objective, lens: Lens, lights: Sequence[Tensor | None], pixels: float, part: slice
    ) -> Tensor:
        """Compute the losses (N,) of all fields of the validation."""
        pupil, views = sobol_disc(VALIDATION_RAYS, seed=0), objective.problem.views_of_validation
        return torch.cat([self.loss(objective, lens, view, pupil, pixels).fields for view in views])


class TaskLoss(CaptureCriterion):
    """Loss of a frozen network in its task, by default classification."""

    def __init__(self, network: nn.Module, task: Task = CLASSIFICATION):
        self.network, self.task = network, task

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,) of each capture, or of their mean if the task has no other."""
        return self.task.losses(self.network, captures, labels)


class JointTaskLoss(TaskLoss):
    """Loss of a network that is trained in place with the lens, by AdamW.

    The batch statistics of its batch norms are those of a micro-batch.

    Args:
        network: network, left in `train()`; parameters that require no gradient stay.
        learning_rate: its learning rate at the first step.
        steps: number of steps.
        final: learning rate at the last step, as a fraction; cosine schedule.
    """

    trained = True

    def __init__(self, network: nn.Module, learning_rate: float, steps: int, final: float, task: Task = CLASSIFICATION):
        super().__init__(network.train(), task)
        self.optimizer = torch.optim.AdamW(parameter_groups(network, _WEIGHT_DECAY), lr=learning_rate)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimizer, lambda step: cosine(step / steps, final))

    @property
    def holders(self) -> dict[str, Any]:
        """Network, optimizer and schedule."""
        return {"network": self.network, "network_optimizer": self.optimizer, "network_schedule": self.schedule}

    def train_step(self) -> None:
        """Step the network's optimizer and schedule."""
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad()

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Put the network into `eval()` within this context."""
        self.network.eval()
        try:
            yield
        finally:
            self.network.train()
