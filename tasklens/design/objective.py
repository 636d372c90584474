"""Objective of a design: a criterion with all that its loss of a lens depends on."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torchvision.transforms.v2 import TrivialAugmentWide
from torchvision.transforms.v2.functional import resize

from tasklens.design.problem import Problem
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import clear_semi_diameters, trace_fields, trace_with_chief
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays, transmission
from tasklens.optics.tolerancing.manufacturing_errors import draw, errors
from tasklens.optics.tolerancing.monte_carlo import MonteCarlo
from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.devices import random_state, set_random_state
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.tolerance_settings import Grade

_PUPIL = (6, 12)  # rings and arms for the relative illumination; within 1e-5 for half of the published lenses
VALIDATION_IMAGES = slice(48)  # images in fixed order; a batch of 8 photographs has losses of 0.1 to 2 for one lens
SELECTION_IMAGES = slice(-192, None)  # other images, if there are enough: 1000 steps overfit the 48
_ENOUGH = 800  # dataset size from which batches exclude the two above
VALIDATION_RAYS = 1024  # rays per field and colour
_VALIDATION_BUILT = 8  # number of built lenses, if the design has a tolerance grade
_VALIDATION_SEED = 9001  # added to the seed: other lenses than reported, other images than in the first steps


class Batch(NamedTuple):
    """Images of a step: their indices (B,), the seed of their noise, and the lens whose illumination they have."""

    indices: Tensor
    seed: int
    design: Lens


class Criterion(ABC):
    """A loss by which a lens is supervised.

    Attributes:
        trained: whether the criterion changes from step to step, so that losses of different steps are not comparable.
        scales_with_stop: whether the loss is proportional to the radius of the stop.
        reads_images: whether it is a loss of captures of images.
    """

    trained = False
    scales_with_stop = False
    reads_images = False

    @abstractmethod
    def loss(
        self, objective: "Objective", lens: Lens, view: View, pupil: Tensor, pixels: float, batch: Batch | None = None
    ) -> "Loss":
        """Compute the loss of a lens at the fields of a view; `batch` are the images of a step."""

    @abstractmethod
    def fixed_losses(
        self, objective: "Objective", lens: Lens, lights: Sequence[Tensor | None], pixels: float, part: slice
    ) -> Tensor:
        """Compute the losses (N,) of a lens as in `Objective.fixed_losses`.

        Args:
            lights: relative illumination (F,) of each view of the validation; empty for a criterion without images.
        """

    @property
    def holders(self) -> dict[str, Any]:
        """Parts with `state_dict` and `load_state_dict` by name; none, unless the criterion is trained."""
        return {}

    def train_step(self) -> None:  # noqa: B027  # most criteria have nothing to train
        """Step the network's optimizer with the accumulated gradients, if the criterion is trained."""

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Compute losses as after training, within this context."""
        yield


@dataclass(frozen=True)
class Loss:
    """Loss of a lens.

    Attributes:
        rays: rays of the lens.
        view: fields of the losses.
        fields: (F,) weighted losses of the fields.
        value: scalar, differentiable in the lens; its gradient is that of the mean loss.
        psfs: (F, 3, K, K) PSFs; None for a loss of rays.
    """

    rays: Rays
    view: View
    fields: Tensor
    value: Tensor
    psfs: Tensor | None


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
        lenses = MonteCarlo(lens, view, errors(replace(design, semi_diameter=radii), self.grade))
        return [lenses.build(fractions)[0] for fractions in draw(lenses.errors, count, seed)]

    def trace(self, lens: Lens, view: View, pupil: Tensor, pixels: float) -> tuple[Rays, Tensor]:
        """Trace rays, and compute PSFs (F, 3, K, K) of unvignetted light; a pixel has `pixels` sensor pixels."""
        if self.centre == "pinhole":
            rays, centre = trace_fields(lens, view, pupil), view.fields
        else:
            rays, centre = trace_with_chief(lens, view, pupil)
        grid = psf(rays, centre, view.pixel_pitch_um * pixels, view.kernel_size)
        return rays, grid / transmission(rays)[..., None, None]

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
        batch = None if indices is None else Batch(indices, seed, design or lens)
        return self.criterion.loss(self, lens, self.problem.view_of_step(seed), pupil, pixels, batch)

    def validation_loss(self, lens: Lens, pixels: float) -> float:
        """Compute the mean loss of a lens, or of lenses built from it, on the fixed images that guide a descent."""
        return float(self.fixed_losses(lens, pixels, VALIDATION_IMAGES).mean())

    def selection_loss(self, lens: Lens, pixels: float) -> float:
        """Compute the mean loss on the images for selection: more and, if there are enough, other ones."""
        return float(self.fixed_losses(lens, pixels, SELECTION_IMAGES).mean())

    def fixed_images(self, part: slice) -> Tensor:
        """Return the indices of a part of the training images in fixed order."""
        generator = torch.Generator().manual_seed(self.problem.seed + _VALIDATION_SEED)
        return torch.randperm(len(self.dataset), generator=generator)[part]

    def batch_images(self) -> Tensor:
        """Return the indices (N,) of the images of the steps; if many, not those of validation and selection."""
        if len(self.dataset) < _ENOUGH:
            return torch.arange(len(self.dataset))
        return self.fixed_images(slice(VALIDATION_IMAGES.stop, SELECTION_IMAGES.start))

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
        views = self.problem.views_of_validation if self.criterion.reads_images else ()
        lights = [self.illumination(lens, view) for view in views]
        losses = [self.criterion.fixed_losses(self, built_lens, lights, pixels, part) for built_lens in lenses]
        set_random_state(state)
        return torch.stack(losses).mean(0)
