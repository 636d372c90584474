"""timm networks that take pictures or captures in [0, 1]."""

from pathlib import Path

import timm
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from tasklens.settings import Classifier


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
    network = timm.create_model(classifier.model, pretrained=pretrained, num_classes=classes, **classifier.arguments)
    path = weights or classifier.weights
    if path is not None:
        network.load_state_dict(load_file(path))
    return Recogniser(network)


def parameters_m(recogniser: Recogniser) -> float:
    """Number of parameters, in millions."""
    return sum(p.numel() for p in recogniser.parameters()) / 1e6
