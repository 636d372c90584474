"""Classifiers: timm networks for images or captures in [0, 1]."""

import copy
import difflib
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from pickle import UnpicklingError
from textwrap import shorten
from typing import Any, Literal, TypeVar, get_args

import timm
import torch
from timm.data import ImageNetInfo
from timm.layers import freeze_batch_norm_2d
from timm.models import load_checkpoint
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from tasklens.recognition import networks
from tasklens.recognition.folding import fold_batch_norms
from tasklens.runtime import user_code
from tasklens.runtime.devices import half_precision
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.settings.network_settings import ClassifierSettings

_Network = TypeVar("_Network", bound=nn.Module)
_LONGEST = 300  # maximum characters of an error from a weights reader; some are a page long


class Classifier(nn.Module):
    """A network with its input normalisation, which is applied after the optics.

    A timm network has its normalisation in its configuration; any other module takes images in [0, 1] unchanged. The
    output is a tensor of logits, or has them as its attribute `logits`.

    Args:
        outputs: indices of the used outputs, the images' classes first; None: all outputs, in order.
    """

    mean: Tensor
    std: Tensor
    outputs: Tensor | None

    def __init__(self, network: nn.Module, outputs: Tensor | None = None):
        super().__init__()
        config: dict[str, Any] = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
        if hasattr(network, "pretrained_cfg"):
            config = timm.data.resolve_model_data_config(network)
        # Channels last makes convolutions train 1.4 to 2 times faster on a CPU, transformers neither faster nor slower.
        # Other networks may have views that need contiguous memory.
        layers = network.children() if isinstance(network, nn.Sequential) else (network,)
        is_timm = any(hasattr(layer, "pretrained_cfg") for layer in layers)
        self.memory_format = torch.channels_last if is_timm else torch.contiguous_format
        self.network = network.to(memory_format=self.memory_format)
        self.register_buffer("mean", torch.tensor(config["mean"])[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(config["std"])[:, None, None], persistent=False)
        self.register_buffer("outputs", outputs, persistent=False)

    @property
    def has_more_outputs(self) -> bool:
        """True if the network has unused outputs; its zero-shot accuracy over all outputs then differs."""
        return self.outputs is not None and len(self.outputs) < ImageNetInfo().num_classes()

    def all_outputs(self, images: Tensor) -> Tensor:
        """Compute the logits (B, outputs) of all network outputs for images (B, 3, H, W) in [0, 1]."""
        normalised = (images - self.mean) / self.std
        with half_precision(images.device):
            logits = self.network(normalised.contiguous(memory_format=self.memory_format))
        logits = getattr(logits, "logits", logits)
        if not isinstance(logits, Tensor):
            raise InputError(f"the network returns a {type(logits).__name__}; expected a tensor of logits")
        return logits.float()

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (B, used outputs) for images (B, 3, H, W) in [0, 1]."""
        logits = self.all_outputs(images)
        return logits if self.outputs is None else logits[:, self.outputs]


def copy_network(network: _Network) -> _Network:
    """Return a copy of a user's network; raises InputError."""
    try:
        return copy.deepcopy(network)
    except Exception as error:  # of any attribute
        raise InputError(
            f"network: cannot be copied: {error}; remove tensors that it keeps of a forward pass"
        ) from error


def of_user(network: nn.Module) -> Classifier:
    """Return a copy of a user's network with its normalisation; print the normalisation of a timm network.

    Raises:
        InputError: the network cannot be copied.
    """
    classifier = Classifier(copy_network(network))
    if hasattr(network, "pretrained_cfg"):
        mean, std = (
            [round(float(value), 4) for value in values.flatten()] for values in (classifier.mean, classifier.std)
        )
        print(
            f"tasklens: images are normalised by the network's pretrained_cfg, with mean {mean} and standard deviation "
            f"{std}; wrap the network in torch.nn.Sequential if it takes images in [0, 1]",
            file=sys.stderr,
        )
    return classifier


def build(settings: ClassifierSettings, classes: Sequence[str], weights: Path | None = None) -> Classifier:
    """Build the network of `settings` for images of these classes.

    Weights are loaded from the file `weights` if it is not None, else from the source in the settings. If the head has
    another number of classes, timm initialises it anew (`pretrained`), or it is rejected (a file).

    Raises:
        FileError: the weights do not fit the network, or ImageNet does not have a class.
        InputError: the published head has another number of classes, and there is no training.
    """
    outputs = used_outputs(settings.outputs, classes)
    count = len(classes) if outputs is None else ImageNetInfo().num_classes()
    pretrained = settings.pretrained and weights is None
    if pretrained and not (settings.training and settings.training.epochs):
        config = timm.get_pretrained_cfg(settings.model)
        if config is not None and config.num_classes != count:
            raise InputError(
                f"{settings.model}: published with {config.num_classes} outputs, but {count} are needed: train a new "
                "head with `training`, or keep its own with `outputs: imagenet`"
            )
    if pretrained:
        networks.check_published(settings.model)
    network = networks.create(settings.model, count, settings.arguments, pretrained)
    path = weights or settings.weights
    if path is not None:
        path.stat()  # timm's error does not name a missing file
        head = _head(network)
        try:
            load_checkpoint(network, str(path), weights_only=True)
        except Exception as error:  # from torch, safetensors, pickle or numpy, depending on the format
            reason = _unreadable(path, error)
            raise FileError(f"{path}: no weights for {settings.model} with {count} outputs: {reason}") from error
        if path.suffix == ".npz" and torch.equal(_head(network), head):  # timm's readers skip a head of another size
            raise FileError(f"{path}: its head is not that of {settings.model} with {count} outputs")
    return Classifier(network, outputs)


def _head(network: nn.Module) -> Tensor:
    """Copy the first parameter of a timm network's head, or the last parameter of any other network."""
    head = network.get_classifier() if hasattr(network, "get_classifier") else network  # type: ignore[operator]
    parameters = list(head.parameters())
    return parameters[0 if head is not network else -1].detach().clone()


def _unreadable(path: Path, error: Exception) -> str:
    """Explain why a file does not hold weights for a network, and what to do."""
    text = str(error)
    if not path.stat().st_size:
        return "the file is empty"
    if "weights_only" in text:
        return (
            "it contains objects other than weights, which are refused: save only the weights, "
            "safetensors.torch.save_file(network.state_dict(), 'mine.safetensors')"
        )
    if mismatch := re.search(r"size mismatch for .*?torch.Size\(\[(\d+)[^]]*\]\) from checkpoint", text):
        head = f"its head has {mismatch[1]} outputs"
        if int(mismatch[1]) == ImageNetInfo().num_classes():
            return f"{head}: for those of ImageNet, set `outputs: imagenet` (on the command line --outputs imagenet)"
    unexpected = re.findall(r'"([^"]+)"', text.partition("Unexpected key(s)")[2])
    prefixes = {name.partition(".")[0] for name in unexpected}
    if "Missing key(s)" in text and len(prefixes) == 1 and len(unexpected) > 1:
        (prefix,) = prefixes
        return f"the names of its weights begin with '{prefix}.': remove this prefix, and save them again"
    if isinstance(error, KeyError | EOFError | UnpicklingError):
        return "it is not a file of weights (.safetensors, .pth, .npz)"
    return shorten(text, _LONGEST, placeholder=" ...")


def used_outputs(outputs: str, classes: Sequence[str]) -> Tensor | None:
    """Return the indices of the used outputs by the setting `outputs`, those of the classes first; None: all, in order.

    Raises:
        InputError: an unknown setting.
        FileError: ImageNet does not have a class.
    """
    if outputs not in (expected := get_args(ClassifierSettings.model_fields["outputs"].annotation)):
        raise InputError(f"outputs: expected {', '.join(expected)}, got {outputs!r}")
    if outputs == "classes":
        return None
    indices = imagenet_outputs(classes)
    if outputs == "imagenet":
        return indices
    others = set(range(ImageNetInfo().num_classes())) - set(indices.tolist())
    return torch.cat([indices, torch.tensor(sorted(others), dtype=torch.long)])


def imagenet_outputs(classes: Sequence[str]) -> Tensor:
    """Return the indices (C,) among ImageNet's 1000 classes of WordNet ids such as n01440764.

    Raises:
        FileError: an unknown id.
    """
    indices = {name: index for index, name in enumerate(ImageNetInfo().label_names())}
    unknown = [name for name in classes if name not in indices]
    if unknown:
        raise FileError(
            f"outputs: imagenet: expected folders named by WordNet ids of ImageNet's classes, got {', '.join(unknown)}"
        )
    return torch.tensor([indices[name] for name in classes])


def frozen(classifier: _Network, images: Tensor, batch_norm: Literal["stored", "batch"] = "stored") -> _Network:
    """Return a copy of a network in `eval()` without parameter gradients, differentiable in its images.

    Args:
        classifier: a network; it stays as it is.
        images: (B, 3, H, W) images of the network's input size; their content does not matter.
        batch_norm: "stored" statistics make batch norms constant affine maps, which are folded into convolutions; this
            saves a quarter of the time and almost half of the memory of a ResNet. "batch" uses the statistics of the
            batch, and leaves the stored ones unchanged.

    Raises:
        InputError: a batch norm has no stored statistics.

    Example:
        >>> network = tasklens.frozen(network, images)
    """
    network = copy.deepcopy(classifier).eval().requires_grad_(False)
    if batch_norm == "stored":
        if any(isinstance(module, _BatchNorm) and module.running_mean is None for module in network.modules()):
            raise InputError("network: a batch norm without stored statistics: its answers depend on the batch")
        fold_batch_norms(network, images[:1])
        memory_format = getattr(classifier, "memory_format", torch.preserve_format)
        return freeze_batch_norm_2d(network).to(memory_format=memory_format)
    for module in network.modules():
        if isinstance(module, _BatchNorm):
            module.train()
            module.momentum = 0.0
    return network


def check(name: str, settings: ClassifierSettings, size: int, classes: int = 10) -> None:
    """Check the model, arguments and image size [pixels] of a classifier; timm models take no memory for weights.

    Args:
        classes: number of classes of the images; a user's function may need it.

    Raises:
        InputError: there is no such model, the arguments or size do not fit it, or its output is not logits or has
            no gradient; the message names the classifier.
    """
    arguments = f" with {settings.arguments}" if settings.arguments else ""
    try:
        with torch.device("cpu" if user_code.is_users(settings.model) else "meta"):
            outputs = classes if settings.outputs == "classes" else ImageNetInfo().num_classes()
            network = networks.create(settings.model, outputs, settings.arguments).eval()
            images = torch.zeros(1, 3, size, size, requires_grad=True)
            answer = network(images)
            answer = getattr(answer, "logits", answer)
    except Exception as error:  # timm raises RuntimeError, TypeError, AssertionError, ..., depending on the layer
        reason = str(error).removeprefix(f"{settings.model}: ")
        if "Unknown model" in reason and (near := difflib.get_close_matches(settings.model, timm.list_models(), 1)):
            reason += f"; did you mean {near[0]}?"
        raise InputError(f"classifiers.{name}: {settings.model}{arguments}: {reason}") from error
    try:
        check_logits(answer, 1, outputs)
    except InputError as error:
        raise InputError(f"classifiers.{name}: {settings.model}{arguments}: {error}") from None


def check_logits(answer: object, images: int, classes: int, exactly: bool = True) -> None:
    """Check that a network's output for `images` images is logits of `classes` classes with a gradient.

    Args:
        exactly: whether the network may have no further outputs.

    Raises:
        InputError: the output is not.
    """
    outputs = 0
    if isinstance(answer, Tensor) and answer.dim() == 2 and len(answer) == images and answer.is_floating_point():
        outputs = answer.shape[1]
    if outputs < classes or (exactly and outputs > classes):
        kind = f"a tensor {tuple(answer.shape)}" if isinstance(answer, Tensor) else type(answer).__name__
        count = f"{images} image{'s' * (images != 1)}"
        raise InputError(
            f"the network returns {kind} for {count} of {classes} classes; expected logits ({images}, {classes}), of a "
            "classifier with an output for each class (labels are numbers from 0), or in Python give a `loss`"
        )
    if isinstance(answer, Tensor) and not answer.requires_grad:
        raise InputError(
            "the network's output has no gradient with respect to its images; one of its layers detaches them"
        )


def parameters_m(classifier: Classifier) -> float:
    """Count the parameters, in millions."""
    return sum(p.numel() for p in classifier.parameters()) / 1e6
