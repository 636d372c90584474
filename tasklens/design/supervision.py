"""Images and network that guide designs: from settings, or of a user in Python."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from tasklens.recognition import class_folders, pairs
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import Task
from tasklens.runtime.devices import claim
from tasklens.runtime.errors import InputError
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.image_settings import RENDERED_CLASSES, ImageSettings
from tasklens.settings.lens_entries import LensDesign

_NAME = "network"  # of the network, in messages
_SHARP = 500  # largest number of sharp images on which the network is tried

Loss = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Supervision:
    """Images, network, and its task if that is not classification; None if a design does not need them."""

    images: ImageDataset | None = None
    network: nn.Module | None = None
    task: "UserTask | None" = None


class UserTask(Task):
    """A task defined by its loss alone: loss(answer of the network, labels)."""

    def __init__(self, loss: Loss):
        self.function = loss

    def loss(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean loss; a label is the same for a flipped image."""
        return self.losses(network, captures, labels).mean()

    def losses(self, network: nn.Module, captures: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,) of each capture; all entries are the mean if the function returns only that."""
        answer = network(captures)
        try:
            losses = self.function(answer, labels)
        except Exception as error:  # of any kind
            raise InputError(f"loss: fails for the answers to {len(captures)} images: {error}") from error
        if not isinstance(losses, Tensor):
            raise InputError(f"loss: expected a tensor, one number or one for each image, got {losses!r}")
        if losses.dim() and losses.shape != (len(captures),):
            raise InputError(f"loss: expected one number or one for each image, got a tensor {tuple(losses.shape)}")
        return losses if losses.dim() else losses.expand(len(captures))


def supervision(plans: Sequence[LensDesign], settings: ImageSettings, folder: Path, user: Supervision) -> Supervision:
    """Return the supervision of designs; a network is first tried on sharp images.

    Args:
        plans: settings of the designs.
        settings: settings of their images.
        folder: folder for a file of converted images.
        user: images, network and task of a user, in place of those of the settings.

    Raises:
        InputError: the network cannot be built, recognises nothing, or has an answer or a loss that cannot be used.
    """
    from tasklens.recognition import classifiers, dataset, sharp

    entries = [plan.entry for plan in plans]
    guided = any(entry.by_network for entry in entries)
    if not any(entry.reads_images for entry in entries):
        return Supervision()
    designs = [entry.design for entry in entries if isinstance(entry.design, GradientDesignSettings)]
    parts = [part for design in designs for part in design.by_network]
    device, network = claim(), user.network
    if not isinstance(network, nn.Module | None):
        raise InputError(f"network: expected a torch.nn.Module or its settings, got {type(network).__name__}")
    if guided and network is None:  # checked before photographs are read
        classifier, classes = next(plan.classifier for plan in plans if plan.classifier), _classes(settings, user)
        for size in sorted({settings.size, *(part.size or settings.size for part in parts)}):
            classifiers.check(_NAME, classifier, size, len(classes))
        torch.manual_seed(0)
        network = classifiers.build(classifier, classes)
    if user.images is not None:
        if guided and user.task is None:
            pairs.check_classes(user.images)
        images = replace(user.images, device=device)
    else:
        if guided and user.task is None and settings.folder is not None:
            class_folders.training_classes(settings.folder)  # two or more
        images = dataset.training_images(settings, folder / "images.npy", device=device)
    if not guided or network is None:
        return Supervision(images)
    if user.network is not None and (user.task is None or hasattr(network, "pretrained_cfg")):
        network = classifiers.of_user(network)
    elif user.network is not None:
        network = classifiers.copy_network(network)
    network = network.to(device)
    trained = any(part.trains_network for entry in entries for part in entry.design.descents)
    if trained and not any(parameter.requires_grad for parameter in network.parameters()):
        raise InputError(
            "network: no parameter requires a gradient, so there is nothing to train; call its requires_grad_(True)"
        )
    if user.network is not None or user.task is not None:
        _check(network, images, user.task, parts, any(design.augment and design.by_network for design in designs))
    if user.task is None:
        sample = images.take(torch.randperm(len(images), generator=torch.Generator().manual_seed(0))[:_SHARP])
        print(f"tasklens: {sharp.check_accuracy(classifiers.frozen(network, images.images), sample)}", file=sys.stderr)
    return Supervision(images, network, user.task)


def _classes(settings: ImageSettings, user: Supervision) -> Sequence[str]:
    """Return the names of the classes of the images, without reading the images."""
    if user.images is not None:
        return user.images.classes
    if settings.folder is not None:
        return class_folders.training_classes(settings.folder)
    return [str(k) for k in range(RENDERED_CLASSES)]


def _check(
    network: nn.Module, dataset: ImageDataset, task: UserTask | None, parts: Sequence[DescentSettings], augmented: bool
) -> None:
    """Check that the answer of a user's network, or its loss, can be used with the settings; raises InputError.

    Args:
        parts: settings of the descents by the network.
        augmented: whether their images are augmented.
    """
    from tasklens.recognition.classifiers import check_logits, frozen

    images, labels = dataset.batch(torch.arange(min(2, len(dataset))))
    images.requires_grad_()
    try:
        frozen_network = frozen(network, images.detach())
        answer = frozen_network(images)
    except Exception as error:  # of any layer
        raise InputError(f"network: fails for images {tuple(images.shape)} of {images.dtype}: {error}") from error
    if task is None:
        check_logits(answer, len(images), len(dataset.classes), exactly=False)
        return
    loss = task.loss(frozen_network, images, labels, torch.zeros(len(images), dtype=torch.bool))
    if not (loss.numel() == 1 and loss.is_floating_point() and bool(loss.isfinite())):
        raise InputError(f"loss: expected a finite number, or one for each image, got {loss}")
    gradient = torch.autograd.grad(loss, images, allow_unused=True)[0] if loss.requires_grad else None
    if gradient is None or not gradient.any():
        raise InputError("loss: has no gradient with respect to the images; the network or the loss detaches them")
    if dataset.labels.dim() > 1 and augmented:
        raise InputError(
            "augment: it shifts and turns images, but not labels such as masks; give settings={'augment': False}"
        )
    if dataset.labels.dim() > 1 and any(part.size is not None for part in parts):
        raise InputError("size: labels of images, such as masks, keep their size; omit it")
    if any(part.temperature != 1 for part in parts):
        raise InputError("temperature: only for the loss of a classifier; omit it if you give a `loss`")
    if any(part.corner_weight != 1 for part in parts) and task.function(answer, labels).dim() == 0:
        raise InputError("corner_weight: expected a `loss` that returns a number for each image, not their mean")
