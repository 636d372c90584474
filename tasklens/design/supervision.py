"""Supervision of a lens by the loss of its captures, through rays, PSFs and captures, and its gradient at the PSFs.

The gradient is computed in stages. The criterion, with its network if it has one, runs in micro-batches of captures,
each of which gives dL/dcapture; then one backward pass through the convolutions gives dL/dPSF, and one passes through
the rays: captures are rendered and rays traced once. This is exact for a network in `eval()`, and with batch statistics
for one micro-batch per step.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.transforms.v2 import TrivialAugmentWide
from torchvision.transforms.v2.functional import resize

from tasklens.design.problem import Problem
from tasklens.design.schedule import cosine
from tasklens.imaging import Camera
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.training import parameter_groups
from tasklens.study.settings import CaptureSettings

VALIDATIONS = 20  # validations of a descent, if all its pixels have their last size
_VALIDATION_IMAGES = 48  # a batch of 8 photographs has losses from 0.1 to 2 for the same lens
_VALIDATION_RAYS = 1024  # rays per field and colour
_WEIGHT_DECAY = 0.05  # of a classifier that is trained with a lens


class Criterion(ABC):
    """A loss for each capture, by which a lens is supervised."""

    @abstractmethod
    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,) of each capture (N, 3, H, W) of sharp images (N, 3, H, W) with labels (N,)."""

    @property
    def holders(self) -> dict[str, Any]:
        """Parts with `state_dict` and `load_state_dict` by name; none, unless the criterion is trained."""
        return {}

    def train(self) -> None:  # noqa: B027  most criteria have nothing to train
        """Take a training step with the accumulated gradients, if the criterion is trained."""

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Give losses as of a finished training."""
        yield


class Classification(Criterion):
    """Cross-entropy of a classifier's logits."""

    def __init__(self, classifier: nn.Module):
        self.classifier = classifier

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the cross-entropy (N,)."""
        return F.cross_entropy(self.classifier(captures), labels, reduction="none")


class JointClassification(Classification):
    """Cross-entropy of a classifier that is trained in place with the lens, by AdamW.

    The batch statistics of its batch norms are those of a micro-batch.

    Args:
        classifier: classifier, left in `train()`.
        learning_rate: its learning rate at the first step.
        steps: number of steps.
        final: learning rate at the last step, as a fraction; cosine schedule.
    """

    def __init__(self, classifier: nn.Module, learning_rate: float, steps: int, final: float):
        super().__init__(classifier.train().requires_grad_(True))
        self.optimizer = torch.optim.AdamW(parameter_groups(classifier, _WEIGHT_DECAY), lr=learning_rate)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimizer, lambda step: cosine(step / steps, final))

    @property
    def holders(self) -> dict[str, Any]:
        """Classifier, optimizer and schedule."""
        return {"network": self.classifier, "network_optimizer": self.optimizer, "network_schedule": self.schedule}

    def train(self) -> None:
        """Take a step of the classifier."""
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad()

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Put the classifier into `eval()` for a while."""
        self.classifier.eval()
        yield
        self.classifier.train()


@dataclass(frozen=True)
class ImageError(Criterion):
    """Mean squared error between capture and sharp image (paper, Eq. 2), or its natural logarithm.

    The logarithm, PSNR up to a factor, gives images of low contrast and fields that are nearly sharp the same vote as
    all others.
    """

    logarithm: bool

    def losses(self, captures: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        """Compute the error (N,)."""
        error = (captures - images).square().mean((-3, -2, -1))
        return error.clamp(min=1e-12).log() if self.logarithm else error


def loss_at_psf(
    criterion: Criterion,
    images: Tensor,
    labels: Tensor,
    grid: Tensor,
    capture: CaptureSettings,
    micro_batch: int,
    illumination: Tensor | None = None,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Compute the mean loss over all captures, and its gradient at the PSFs.

    Network parameters that require a gradient accumulate theirs.

    Args:
        images: (B, 3, H, W) sharp images in [0, 1].
        labels: (B,) labels.
        grid: (F, 3, K, K) PSFs.
        micro_batch: maximum number of the F B captures that the criterion takes at once.
        illumination: (F,) relative illumination, for a sensor.
        seed: seed of the noise.

    Returns:
        Loss of each field (F,), whose mean is the loss L, and dL/dPSF like `grid`; on its device and of its dtype.
    """
    leaf = grid.detach().to(images).requires_grad_()
    camera = Camera(leaf, capture.outside_window, capture.colour, capture.sensor, illumination)
    captures = camera.grid(images, torch.Generator().manual_seed(seed))
    inputs, source = captures.detach().flatten(0, 1), torch.arange(len(images)).repeat(len(grid))
    parts = math.ceil(len(inputs) / micro_batch)
    losses, gradients = [], []
    for part, of in zip(inputs.chunk(parts), source.chunk(parts), strict=True):
        part.requires_grad_()
        loss = criterion.losses(part, images[of], labels[of])
        (loss.sum() / len(inputs)).backward()
        losses.append(loss.detach())
        gradients.append(_gradient(part))
    captures.backward(torch.cat(gradients).reshape(captures.shape))
    return torch.cat(losses).reshape(len(grid), -1).mean(-1).to(grid), _gradient(leaf).to(grid)


def _gradient(leaf: Tensor) -> Tensor:
    """Return the gradient of a leaf after a backward pass."""
    assert leaf.grad is not None
    return leaf.grad


@dataclass(frozen=True)
class Supervisor:
    """A criterion on captures that supervises a lens.

    Attributes:
        criterion: loss of each capture.
        problem: design problem with capture and dataset.
        size: side of the resized images [pixels]; None: not resized.
        augment: whether TrivialAugment is applied to the sharp images.
        micro_batch: maximum number of captures that the criterion takes at once.
        centre: centre of PSFs; on the pinhole points errors of focal length and distortion increase the loss.
    """

    criterion: Criterion
    problem: Problem
    size: int | None
    augment: bool
    micro_batch: int
    centre: Literal["pinhole", "chief_ray"] = "pinhole"

    @property
    def dataset(self) -> ImageDataset:
        """Sharp training images."""
        assert self.problem.dataset is not None  # a supervised problem has one
        return self.problem.dataset

    @property
    def capture(self) -> CaptureSettings:
        """Capture settings."""
        assert self.problem.capture is not None
        return self.problem.capture

    def images(self, indices: Tensor, augment: bool) -> tuple[Tensor, Tensor]:
        """Return sharp images (B, 3, H, W) in [0, 1], resized and optionally augmented, and their labels (B,)."""
        dataset = self.dataset
        images = dataset.images[indices].to(dataset.device)
        if self.size is not None:
            images = resize(images, [self.size, self.size])
        if augment:
            transform = TrivialAugmentWide()
            images = torch.stack([transform(image) for image in images])
        return images.float() / 255, dataset.labels[indices].to(dataset.device)

    def trace(self, lens: Lens, pupil: Tensor, pixels: float) -> tuple[Rays, Tensor]:
        """Trace rays, and compute PSFs (F, 3, K, K) at a pixel pitch of `pixels` sensor pixels."""
        view = self.problem.view
        rays = trace_fields(lens, view, pupil)
        centre = view.fields if self.centre == "pinhole" else chief_points(lens, view)
        return rays, psf(rays, centre, view.pixel_pitch * pixels, view.kernel_size)

    def illumination(self, lens: Lens) -> Tensor | None:
        """Compute the relative illumination (F,), which a sensor needs, without gradient."""
        return relative_illumination(lens.detached(), self.problem.view) if self.capture.sensor else None

    def loss(self, indices: Tensor, grid: Tensor, lens: Lens, seed: int) -> tuple[Tensor, Tensor]:
        """Compute the loss (F,) of each field on these images through PSFs, and the gradient of its mean at these.

        Args:
            lens: lens of the PSFs, for its illumination.
            seed: seed of a sensor's noise.
        """
        images, labels = self.images(indices, self.augment)
        light = self.illumination(lens)
        return loss_at_psf(self.criterion, images, labels, grid, self.capture, self.micro_batch, light, seed)

    @torch.no_grad()
    def validation_loss(self, lens: Lens, pixels: float) -> float:
        """Compute the mean loss of a lens on a fixed set of training images, without augmentation."""
        _, grid = self.trace(lens, sobol_disc(_VALIDATION_RAYS, seed=0), pixels)
        generator = torch.Generator().manual_seed(self.problem.seed)
        fixed = torch.randperm(len(self.dataset), generator=generator)[:_VALIDATION_IMAGES]
        images, labels = self.images(fixed, augment=False)
        capture = self.capture
        light = self.illumination(lens)
        camera = Camera(grid.to(images), capture.outside_window, capture.colour, capture.sensor, light)
        found = []
        # Micro-batches hold all fields of an image, since batch norms in batch mode need them in every batch.
        at_once = max(1, self.micro_batch // len(grid))
        with self.criterion.evaluating():
            for some, classes in zip(images.split(at_once), labels.split(at_once), strict=True):
                captures = camera.grid(some)
                sharp, targets = some.repeat(len(grid), 1, 1, 1), classes.repeat(len(grid))
                found.append(self.criterion.losses(captures.flatten(0, 1), sharp, targets))
        return float(torch.cat(found).mean())


def energy_in_window(grid: Tensor) -> float:
    """Compute the mean energy of PSFs (F, W, K, K) inside their window."""
    return float(grid.detach().sum((-2, -1)).mean())
