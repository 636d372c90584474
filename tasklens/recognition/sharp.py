"""Accuracy of a network on sharp images, as a check before it designs or ranks lenses."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.errors import InputError

_BATCH = 32
_DEVIATIONS = 3.0  # standard deviations above the accuracy of guessing


class TooFewImages(InputError):
    """Too few images to tell a network from guessing."""


@torch.no_grad()
def check_accuracy(network: Callable[[Tensor], Tensor], dataset: ImageDataset) -> str:
    """Return a sentence with the accuracy of a network on sharp images.

    Args:
        network: function from images (B, 3, H, W) in [0, 1] to logits.

    Raises:
        InputError: the accuracy is no better than guessing, or there are too few images to tell (TooFewImages).
    """
    correct, outputs = [], len(dataset.classes)
    for indices in torch.arange(len(dataset)).split(_BATCH):
        images, labels = dataset.batch(indices)
        logits = network(images)
        outputs = logits.shape[-1]
        correct.append(logits.argmax(-1) == labels)
    return better_than_guessing(float(torch.cat(correct).double().mean()), len(dataset), outputs)


def better_than_guessing(accuracy: float, count: int, outputs: int) -> str:
    """Return a sentence with an accuracy on `count` sharp images; raises InputError as `check_accuracy` does."""
    if outputs < 2:
        raise InputError("the network has one output; expected one for each of at least two classes")
    chance = 1 / outputs
    text = f"the network recognises {accuracy:.1%} of {count} sharp images (guessing: {chance:.1%})"
    margin = _DEVIATIONS * math.sqrt(chance * (1 - chance) / count)
    if chance + margin >= 1:
        raise TooFewImages(f"{text}: too few images to tell it from guessing; give more")
    if accuracy <= chance + margin:
        raise InputError(
            f"{text}: no better than guessing; check its weights, its normalisation (arguments: "
            "{pretrained_cfg_overlay: {mean: [..], std: [..]}}), the order of its classes, and `outputs`"
        )
    return text
