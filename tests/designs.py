"""Small design problems: a view, its limits, fields, images and a network, and descents on them."""

import torch
from examples import by_descents, random_images
from torch import nn

from tasklens.design.criteria import JointTaskLoss, TaskLoss
from tasklens.design.image_quality import ImageError, SpotRadius
from tasklens.design.problem import Problem
from tasklens.fields import GRADING, SELECTION, Points
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import frozen
from tasklens.runtime.checkpoints import NO_CHECKPOINT
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DescentSettings, LearningRates
from tasklens.settings.specification import Constraints, Spec

SPEC, LIMITS = Spec(kernel_size=11), Constraints()
VIEW = view_of_spec(SPEC)
NO_LIMITS = Constraints.model_construct(**{key: 1e9 if "max" in key else -1e9 for key in Constraints.model_fields})
NO_LIMITS = NO_LIMITS.model_copy(update={"efl_tolerance": 1e9, "distortion": 1e9, "max_chief_ray_angle_deg": None})
LEARNING_RATES = LearningRates(curvature=1e-2, thickness=5e-3, alpha_4=1e-2, decay=0.5)
RESTARTS = DescentSettings(steps=3, pixels=(20, 5), lenses=2)
REFINEMENT = DescentSettings(steps=2, pixels=(5, 1))
GRADED, SELECTED = (sum(sets, ()) for sets in (GRADING, SELECTION))  # all fields of each
OWN: Points = ((0.0, 0.0), (0.6, 0.2), (0.3, 0.7), (1.0, 1.0), (0.9, 0.4))  # a list of fields in a study


def problem(limits=LIMITS, classes=3) -> Problem:
    """Twelve images of 16 x 16 pixels before lenses of this view and these limits."""
    return Problem(VIEW, limits, 1, CaptureSettings(), random_images(12, 16, classes, seed=0))


def tiny_network(seed: int = 0) -> nn.Module:
    """A network of one convolution for three classes, with a batch norm and one feature per quadrant and channel."""
    torch.manual_seed(seed)
    layers = nn.Conv2d(3, 6, 3, stride=2), nn.BatchNorm2d(6), nn.ReLU(), nn.AdaptiveAvgPool2d(2), nn.Flatten()
    return nn.Sequential(*layers, nn.Linear(24, 3))


def adamw_descent(network, lens, checkpoint=NO_CHECKPOINT, classes=3, **settings):
    """Lens and history of a descent by AdamW with this network, trained in place or frozen."""
    defaults = {
        "optimizer": "adamw",
        "steps": 3,
        "learning_rates": LEARNING_RATES,
        "final": 1.0,
        "network_learning_rate": 1e-3,
    }
    part, design_problem = DescentSettings(**(defaults | settings)), problem(classes=classes)

    def criterion(part):
        if part.network_learning_rate is None:
            return TaskLoss(network.eval().requires_grad_(False))
        return JointTaskLoss(network, part.network_learning_rate, part.steps, part.final)

    return by_descents(lens, criterion, design_problem, part, augment=True, micro_batch=36, checkpoint=checkpoint)[::2]


def image_error(part) -> ImageError:
    """The image error, or its logarithm, as a descent asks for."""
    return ImageError(part.criterion == "log_image_error")


def task_design(network, lens, limits=LIMITS, parts=(RESTARTS, REFINEMENT), batch_norm="stored", **settings):
    """Lens and history of restarts and a refinement on the loss of this network, which is frozen."""
    task = problem(limits)
    supervisor = TaskLoss(frozen(network, task.dataset.images, batch_norm))
    options = {"augment": True, "batch_norm": batch_norm} | settings
    return by_descents(lens, lambda part: supervisor, task, *parts, **options)[::2]


def spot_descent(start: Lens) -> Lens:
    """The lens after 200 steps of spot descent."""
    settings = DescentSettings(
        optimizer="adamw",
        criterion="spot",
        steps=200,
        learning_rates=LearningRates(curvature=2e-2, thickness=5e-3, alpha_4=1e-2),
        betas=(0.9, 0.99),
        final=1.0,
        stop_scale=0.3,
    )
    return by_descents(start, lambda part: SpotRadius(), Problem(VIEW, LIMITS, 0), settings, rays=64)[0]
