"""timm networks that take pictures or captures in [0, 1]."""

import copy
from pathlib import Path
from typing import Literal

import timm
import torch
from safetensors.torch import load_file
from timm.layers import freeze_batch_norm_2d
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from tasklens.settings import Classifier
from tasklens.study import StudyError


class Recogniser(nn.Module):
    """A timm network behind its own normalisation, which belongs to the network and comes after the optics."""

    def __init__(self, network: nn.Module):
        super().__init__()
        config = timm.data.resolve_model_data_config(network)
        # Channels last: convolutions train 1.4 to 2 times faster on a CPU, transformers as before.
        self.network = network.to(memory_format=torch.channels_last)
        self.register_buffer("mean", torch.tensor(config["mean"])[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(config["std"])[:, None, None], persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Logits (B, classes) of images (B, 3, H, W) in [0, 1]."""
        normalised = (images - self.mean) / self.std
        return self.network(normalised.contiguous(memory_format=torch.channels_last))


def build(classifier: Classifier, classes: int, weights: Path | None = None) -> Recogniser:
    """The network that `classifier` names, with `classes` outputs.

    Weights come from the file `weights` where it is given, else from where the classifier says; a head whose number
    of classes differs is initialised anew by timm (`pretrained`) or refused (a file).
    """
    pretrained = classifier.pretrained and weights is None
    if pretrained and classifier.training is None:
        published = timm.get_pretrained_cfg(classifier.model)
        if published is not None and published.num_classes != classes:
            raise StudyError(
                f"{classifier.model}: published with {published.num_classes} classes, the pictures have {classes}: "
                "its new head needs `training`"
            )
    network = timm.create_model(classifier.model, pretrained=pretrained, num_classes=classes, **classifier.arguments)
    path = weights or classifier.weights
    if path is not None:
        network.load_state_dict(load_file(path))
    return Recogniser(network)


def frozen(recogniser: nn.Module, batch_norm: Literal["stored", "batch"] = "stored") -> nn.Module:
    """A copy in `eval()` that takes no gradient itself, but passes one on to its images.

    Args:
        batch_norm: by the stored statistics, batch norms are constant affine maps, which need not keep their inputs:
            almost half of the memory of a ResNet. By those of the batch, they are in `train()`, but keep what they have
            stored, too.
    """
    copied = copy.deepcopy(recogniser).eval().requires_grad_(False)
    if batch_norm == "stored":
        return freeze_batch_norm_2d(copied)
    for module in copied.modules():
        if isinstance(module, _BatchNorm):
            module.train()
            module.momentum = 0.0
    return copied


def check(name: str, classifier: Classifier, size: int) -> None:
    """Build a network without memory for its weights, and pass a picture of `size` pixels through it.

    Raises:
        StudyError: naming the classifier, where timm does not know the model or the arguments or size do not fit it.
    """
    try:
        with torch.device("meta"):
            network = timm.create_model(classifier.model, num_classes=10, **classifier.arguments).eval()
            network(torch.zeros(1, 3, size, size))
    except Exception as error:  # timm raises RuntimeError, TypeError, AssertionError, ..., whichever layer notices
        raise StudyError(f"classifiers.{name}: {classifier.model} with {classifier.arguments}: {error}") from error


def parameters_m(recogniser: Recogniser) -> float:
    """Number of parameters, in millions."""
    return sum(p.numel() for p in recogniser.parameters()) / 1e6
