"""A classifier's loss as a supervisor: from a lens through rays, PSFs and captures to a loss, and back to the PSFs.

The gradient is taken in stages. The network runs in micro-batches of captures, each of which leaves dL/dcapture; then
one backward pass carries that through the convolutions to dL/dPSF, and one through the rays: captures are rendered and
rays traced once. This is exact while the network is in `eval()`; while it is trained with batch statistics, one
micro-batch per step makes it exact as well.
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
    """That of a leaf after a backward pass."""
    assert leaf.grad is not None
    return leaf.grad


@dataclass(frozen=True)
class Supervisor:
    """A classifier that judges captures through a lens.

    Attributes:
        classifier: takes images (B, 3, H, W) in [0, 1].
        problem: with capture and dataset.
        size: side to which images are reduced [pixels]; None leaves them.
        augment: whether TrivialAugment acts on the sharp images.
        micro_batch: the most captures that pass through the network at once.
    """

    classifier: nn.Module
    problem: Problem
    size: int | None
    augment: bool
    micro_batch: int

    @property
    def dataset(self) -> ImageDataset:
        """The sharp training images."""
        assert self.problem.dataset is not None  # a supervised problem has one
        return self.problem.dataset

    @property
    def capture(self) -> CaptureSettings:
        """How images become captures."""
        assert self.problem.capture is not None
        return self.problem.capture

    def images(self, indices: Tensor, augment: bool) -> tuple[Tensor, Tensor]:
        """Sharp images (B, 3, H, W) in [0, 1] and their labels, as the design sees them."""
        dataset = self.dataset
        images = dataset.images[indices].to(dataset.device)
        if self.size is not None:
            images = resize(images, [self.size, self.size])
        if augment:
            transform = TrivialAugmentWide()
            images = torch.stack([transform(image) for image in images])
        return images.float() / 255, dataset.labels[indices].to(dataset.device)

    def trace(self, lens: Lens, pupil: Tensor, pixels: float) -> tuple[Rays, Tensor]:
        """Rays through a lens, and its PSFs (F, 3, K, K) at a pixel pitch that is `pixels` times the true one.

        PSFs are centred on the pinhole points, which holds the lens to its focal length and distortion.
        """
        view = self.problem.view
        rays = trace_fields(lens, view, pupil)
        return rays, psf(rays, view.fields, view.pixel_pitch * pixels, view.kernel_size)

    def loss(self, indices: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
        """Loss of each field (F,) on these images through these PSFs, and the gradient of its mean at the PSFs."""
        images, labels = self.images(indices, self.augment)
        return loss_at_psf(self.classifier, images, labels, grid, self.capture, self.micro_batch)

    @torch.no_grad()
    def validation_loss(self, lens: Lens, indices: Tensor, pupil: Tensor, pixels: float) -> float:
        """Mean loss of a lens on images without augmentation; infinite if it is not finite."""
        _, grid = self.trace(lens, pupil, pixels)
        images, labels = self.images(indices, augment=False)
        captures = Camera(grid.to(images), self.capture.outside_window, self.capture.colour).grid(images)
        # Every batch holds all fields, as those of a descent do: it matters to batch norms by the batch.
        inputs, targets = captures.transpose(0, 1).flatten(0, 1), labels.repeat_interleave(len(grid))
        parts = zip(inputs.split(self.micro_batch), targets.split(self.micro_batch), strict=True)
        loss = sum(float(F.cross_entropy(self.classifier(part), target, reduction="sum")) for part, target in parts)
        return loss / len(inputs) if math.isfinite(loss) else math.inf


def energy_in_window(grid: Tensor) -> float:
    """Mean energy of PSFs (F, W, K, K) inside their window."""
    return float(grid.detach().sum((-2, -1)).mean())
