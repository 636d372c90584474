"""Objective of a design: the loss of the rays, PSFs or captures of a lens, and the gradient of that loss.

For captures the gradient is computed in stages. The criterion, with its network if it has one, runs in micro-batches of
captures, and each gives dL/dcapture. Then one backward pass through the convolutions gives dL/dPSF, and one more passes
through the rays, so that captures are rendered and rays traced once. This is exact for a network in `eval()`; with
batch statistics, it is exact for one micro-batch per step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torchvision.transforms.v2 import TrivialAugmentWide
from torchvision.transforms.v2.functional import resize

from tasklens.camera.imaging import PsfCamera
from tasklens.design.criteria import CaptureCriterion, Criterion, FieldCriterion
from tasklens.design.problem import Problem
from tasklens.optics.analysis import focus
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, clear_semi_diameters, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays
from tasklens.optics.tolerancing.errors import draw, errors, with_errors
from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.devices import random_state, set_random_state
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.tolerance_settings import Grade

_PUPIL = (6, 12)  # rings and arms for the relative illumination; within 1e-5 for half of the published lenses
VALIDATION = slice(48)  # images in fixed order; a batch of 8 photographs has losses from 0.1 to 2 for the same lens
SELECTION = slice(-192, None)  # other images, if there are enough: 1000 steps overfit the 48
_ENOUGH = 1000  # dataset size from which batches exclude the two above
_VALIDATION_RAYS = 1024  # rays per field and colour
_VALIDATION_BUILT = 8  # number of built lenses, if the design has a tolerance grade
_VALIDATION_SEED = 9001  # added to the seed: other lenses than reported, other images than in the first steps


def loss_at_psf(
    criterion: CaptureCriterion,
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
        gradients.append(_gradient(batch))
    captures.backward(torch.cat(gradients).reshape(captures.shape))
    return torch.cat(losses).reshape(len(grid), -1).mean(-1).to(grid), _gradient(leaf).to(grid)


def _energy(grid: Tensor) -> float:
    """Return the mean energy of PSFs inside their window."""
    return float(grid.detach().sum((-2, -1)).mean())


def _gradient(leaf: Tensor) -> Tensor:
    """Return the gradient of a leaf after a backward pass."""
    assert leaf.grad is not None
    return leaf.grad


@dataclass(frozen=True)
class Loss:
    """Loss of a lens.

    Attributes:
        rays: rays of the lens.
        view: fields of the losses.
        fields: (F,) weighted losses of the fields.
        value: scalar, differentiable in the lens; its gradient is that of the mean loss.
        energy: mean energy of the PSFs inside their window; None for a loss of rays.
    """

    rays: Rays
    view: View
    fields: Tensor
    value: Tensor
    energy: float | None


@dataclass(frozen=True)
class Objective:
    """A criterion with all that its loss of a lens depends on.

    Attributes:
        criterion: loss of rays, of PSFs, or of captures.
        problem: design problem; for losses of captures, it has `capture` and `dataset`.
        size: side of the resized images [pixels]; None: not resized.
        augment: whether TrivialAugment is applied to the sharp images.
        micro_batch: maximum number of captures that the criterion takes at once.
        centre: centre of PSFs; at the pinhole points, errors of focal length and distortion increase the loss.
        grade: tolerance grade of the built lenses that are evaluated; None: the design itself is evaluated.
        corner_weight: weight of the corner in the mean, geometric over the radius from 1 on the axis.
    """

    criterion: Criterion
    problem: Problem
    size: int | None
    augment: bool
    micro_batch: int
    centre: Literal["pinhole", "chief_ray"] = "pinhole"
    grade: Grade | None = None
    corner_weight: float = 1.0

    def weights(self, view: View) -> Tensor:
        """Return the weights (F,) of fields, with mean 1."""
        weights = self.corner_weight ** (view.radii / self.problem.view.radii.max())
        return weights / weights.mean()

    @property
    def dataset(self) -> ImageDataset:
        """Sharp training images."""
        assert self.problem.dataset is not None  # a supervised problem has a dataset
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

    def as_built(self, lens: Lens, seed: int, count: int = 1) -> list[Lens]:
        """Return focused lenses built from a design, differentiable in it; without a grade, the design itself."""
        if self.grade is None:
            return [lens]
        view, design = self.problem.view, lens.detached()
        radii = torch.minimum(design.semi_diameter, clear_semi_diameters(design, view))
        error_list = errors(replace(design, semi_diameter=radii), self.grade)
        peak = focus.peak(lens, view)
        lenses = [with_errors(lens, error_list, sample, view.reference_um) for sample in draw(error_list, count, seed)]
        return [focus.focus_built(built_lens, view, peak)[0] for built_lens in lenses]

    def trace(self, lens: Lens, view: View, pupil: Tensor, pixels: float) -> tuple[Rays, Tensor]:
        """Trace rays, and compute PSFs (F, 3, K, K) at a pixel pitch of `pixels` sensor pixels."""
        rays = trace_fields(lens, view, pupil)
        centre = view.fields if self.centre == "pinhole" else chief_points(lens, view)
        return rays, psf(rays, centre, view.pixel_pitch_um * pixels, view.kernel_size)

    def illumination(self, lens: Lens, view: View) -> Tensor | None:
        """Compute the relative illumination (F,) for a sensor, without gradient; None without a sensor."""
        if self.capture.sensor is None:
            return None
        return relative_illumination(lens.detached(), view, *_PUPIL)

    def loss(
        self, lens: Lens, pupil: Tensor, pixels: float, indices: Tensor | None, seed: int, design: Lens | None = None
    ) -> Loss:
        """Compute the loss of a lens at the fields of a step.

        Args:
            pupil: (N, 2) pupil points of the rays.
            pixels: pixel pitch [sensor pixels].
            indices: (B,) indices of the images.
            seed: seed of the fields and of a sensor's noise.
            design: lens for the illumination, if `lens` is built from it.
        """
        criterion, view = self.criterion, self.problem.view_of_step(seed)
        if isinstance(criterion, FieldCriterion):
            return self._loss_of_fields(criterion, lens, view, pupil, pixels)
        assert isinstance(criterion, CaptureCriterion) and indices is not None
        rays, grid = self.trace(lens, view, pupil, pixels)
        images, labels = self.images(indices, self.augment)
        settings = self.capture, self.micro_batch, self.illumination(design or lens, view), seed, self.weights(view)
        losses, gradient = loss_at_psf(criterion, images, labels, grid, *settings)
        return Loss(rays, view, losses, (grid * gradient).sum(), _energy(grid))

    def _loss_of_fields(self, criterion: FieldCriterion, lens: Lens, view: View, pupil: Tensor, pixels: float) -> Loss:
        """Compute the loss of a lens without images."""
        rays, grid = (
            self.trace(lens, view, pupil, pixels) if criterion.by_psf else (trace_fields(lens, view, pupil), None)
        )
        losses = self.weights(view) * criterion.of_fields(rays, grid, view)
        return Loss(rays, view, losses.detach(), losses.mean(), None if grid is None else _energy(grid))

    def validation_loss(self, lens: Lens, pixels: float) -> float:
        """Compute the mean loss of a lens, or of lenses built from it, on the fixed images that guide a descent."""
        return float(self.fixed_losses(lens, pixels, VALIDATION).mean())

    def selection_loss(self, lens: Lens, pixels: float) -> float:
        """Compute the mean loss on the images for selection: more and, if there are enough, other ones."""
        return float(self.fixed_losses(lens, pixels, SELECTION).mean())

    def fixed_images(self, part: slice) -> Tensor:
        """Return the indices of a part of the training images in fixed order."""
        generator = torch.Generator().manual_seed(self.problem.seed + _VALIDATION_SEED)
        return torch.randperm(len(self.dataset), generator=generator)[part]

    def batch_images(self) -> Tensor:
        """Return the indices (N,) of the images of the steps; if many, not those of validation and selection."""
        if len(self.dataset) < _ENOUGH:
            return torch.arange(len(self.dataset))
        return self.fixed_images(slice(VALIDATION.stop, SELECTION.start))

    @torch.no_grad()
    def fixed_losses(self, lens: Lens, pixels: float, part: slice) -> Tensor:
        """Compute the losses (N,) of a lens, or of lenses built from it, on a part of the images in fixed order.

        For captures, N counts images, and a loss is the mean over the fields whose turn it is. For rays and PSFs, N
        counts all fields.
        Networks that draw random numbers, such as detectors that sample boxes, draw the same for every lens.
        """
        lenses = self.as_built(lens, self.problem.seed + _VALIDATION_SEED, _VALIDATION_BUILT)
        state = random_state()
        torch.manual_seed(self.problem.seed)
        criterion, views = self.criterion, self.problem.views_of_validation
        if isinstance(criterion, FieldCriterion):
            options = sobol_disc(_VALIDATION_RAYS, seed=0), pixels
            of_views = [[self._loss_of_fields(criterion, each, view, *options) for view in views] for each in lenses]
            losses = [torch.cat([loss.fields for loss in of_lens]) for of_lens in of_views]
        else:
            lights = [self.illumination(lens, view) for view in views]
            losses = [self._capture_losses(part, built_lens, views, lights, pixels) for built_lens in lenses]
        set_random_state(state)
        return torch.stack(losses).mean(0)

    def _capture_losses(
        self, part: slice, lens: Lens, views: Sequence[View], lights: Sequence[Tensor | None], pixels: float
    ) -> Tensor:
        """Compute the losses (N,) of images that take the views in turns, without augmentation.

        Args:
            lights: relative illumination (F,) of each view.
        """
        criterion, indices = self.criterion, self.fixed_images(part)
        assert isinstance(criterion, CaptureCriterion)
        noise = torch.Generator().manual_seed(self.problem.seed)  # drawn by image, so independent of micro-batches
        losses = torch.empty(len(indices))
        for turn, (view, light) in enumerate(zip(views[: len(indices)], lights, strict=False)):
            images, labels = self.images(indices[turn :: len(views)], augment=False)
            _, grid = self.trace(lens, view, sobol_disc(_VALIDATION_RAYS, seed=0), pixels)
            camera, weights = PsfCamera.of(self.capture, grid.to(images), light), self.weights(view).to(images)
            # Micro-batches hold all fields of an image: batch norms in batch mode need them in every batch.
            batch_size = max(1, self.micro_batch // len(grid))
            of_turn = []
            with criterion.evaluating():
                for batch, batch_labels in zip(images.split(batch_size), labels.split(batch_size), strict=True):
                    captures = camera.all_fields(batch, noise)
                    sharp, targets = (torch.cat([values] * len(grid)) for values in (batch, batch_labels))
                    of_batch = criterion.losses(captures.flatten(0, 1), sharp, targets).reshape(len(grid), -1)
                    of_turn.append((weights[:, None] * of_batch).mean(0))
            losses[turn :: len(views)] = torch.cat(of_turn).to(losses)
        return losses
