"""Supervision of a lens by a classifier's loss, through rays, PSFs and captures, and its gradient at the PSFs.

The gradient is computed in stages. The network runs in micro-batches of captures, each of which gives dL/dcapture; then
one backward pass through the convolutions gives dL/dPSF, and one passes through the rays: captures are rendered and
rays traced once. This is exact for a network in `eval()`, and with batch statistics for one micro-batch per step.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.transforms.v2 import TrivialAugmentWide
from torchvision.transforms.v2.functional import resize

from tasklens.design.problem import Problem
from tasklens.imaging import Camera
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays
from tasklens.recognition.dataset import ImageDataset
from tasklens.study.settings import CaptureSettings


def loss_at_psf(
    classifier: nn.Module, images: Tensor, labels: Tensor, grid: Tensor, capture: CaptureSettings, micro_batch: int
) -> tuple[Tensor, Tensor]:
    """Compute the mean cross-entropy over all captures, and its gradient at the PSFs.

    Network parameters that require a gradient accumulate theirs.

    Args:
        images: (B, 3, H, W) sharp images in [0, 1].
        labels: (B,) labels.
        grid: (F, 3, K, K) PSFs.
        micro_batch: maximum number of the F B captures per forward pass.

    Returns:
        Loss of each field (F,), whose mean is the loss L, and dL/dPSF like `grid`; on its device and of its dtype.
    """
    leaf = grid.detach().to(images).requires_grad_()
    captures = Camera(leaf, capture.outside_window, capture.colour).grid(images)
    inputs, targets = captures.detach().flatten(0, 1), labels.repeat(len(grid))
    parts = math.ceil(len(inputs) / micro_batch)
    losses, gradients = [], []
    for part, target in zip(inputs.chunk(parts), targets.chunk(parts), strict=True):
        part.requires_grad_()
        loss = F.cross_entropy(classifier(part), target, reduction="none")
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
    """A classifier whose loss on captures supervises a lens.

    Attributes:
        classifier: network for images (B, 3, H, W) in [0, 1].
        problem: design problem with capture and dataset.
        size: side of the resized images [pixels]; None: not resized.
        augment: whether TrivialAugment is applied to the sharp images.
        micro_batch: maximum number of captures per forward pass.
    """

    classifier: nn.Module
    problem: Problem
    size: int | None
    augment: bool
    micro_batch: int

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
        """Trace rays, and compute PSFs (F, 3, K, K) at a pixel pitch of `pixels` sensor pixels.

        PSFs are centred on the pinhole points, so that errors of focal length and distortion increase the loss.
        """
        view = self.problem.view
        rays = trace_fields(lens, view, pupil)
        return rays, psf(rays, view.fields, view.pixel_pitch * pixels, view.kernel_size)

    def loss(self, indices: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the loss (F,) of each field on these images through PSFs, and the gradient of its mean at these."""
        images, labels = self.images(indices, self.augment)
        return loss_at_psf(self.classifier, images, labels, grid, self.capture, self.micro_batch)

    @torch.no_grad()
    def validation_loss(self, lens: Lens, indices: Tensor, pupil: Tensor, pixels: float) -> float:
        """Compute the mean loss of a lens on images without augmentation; infinite if it is not finite."""
        _, grid = self.trace(lens, pupil, pixels)
        images, labels = self.images(indices, augment=False)
        captures = Camera(grid.to(images), self.capture.outside_window, self.capture.colour).grid(images)
        # Captures are ordered by image, since batch norms in batch mode need all fields in every batch.
        inputs, targets = captures.transpose(0, 1).flatten(0, 1), labels.repeat_interleave(len(grid))
        parts = zip(inputs.split(self.micro_batch), targets.split(self.micro_batch), strict=True)
        loss = sum(float(F.cross_entropy(self.classifier(part), target, reduction="sum")) for part, target in parts)
        return loss / len(inputs) if math.isfinite(loss) else math.inf


def energy_in_window(grid: Tensor) -> float:
    """Compute the mean energy of PSFs (F, W, K, K) inside their window."""
    return float(grid.detach().sum((-2, -1)).mean())
