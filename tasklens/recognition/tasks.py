"""Tasks of networks on images: loss, answers, and scores.

The images of a task are an `ImageDataset`. The task defines the meaning of its labels: classes in classification, image
indices in tasks on objects.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Task(ABC):
    """A task of networks: loss, answers, and scores."""

    @abstractmethod
    def loss(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean loss of captures (N, 3, H, W) in [0, 1] with labels (N,).

        Args:
            flipped: (N,) whether the image was flipped left to right after it was labelled.
        """

    def losses(self, network: nn.Module, captures: Tensor, labels: Tensor) -> Tensor:
        """Compute the loss (N,) of each capture; by default, every entry is the mean loss."""
        return self.loss(network, captures, labels, torch.zeros_like(labels, dtype=torch.bool)).expand(len(captures))

    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Any]:
        """Return the answer for each capture, on the CPU; a task needs answers only to be scored."""
        raise NotImplementedError

    def scores(self, answers: Sequence[Any], labels: Tensor) -> Mapping[str, float]:
        """Return the scores of answers for images with labels (N,), by name; the first is the main score."""
        raise NotImplementedError


@dataclass(frozen=True)
class Classification(Task):
    """Classification of images; `evaluation.measure` has its accuracy.

    Attributes:
        temperature: T of the loss T cross_entropy(logits / T).
    """

    temperature: float = 1.0

    def loss(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean cross-entropy; a flipped image has the same label."""
        return self.temperature * F.cross_entropy(network(captures) / self.temperature, labels)

    def losses(self, network: nn.Module, captures: Tensor, labels: Tensor) -> Tensor:
        """Compute the cross-entropy (N,)."""
        return self.temperature * F.cross_entropy(network(captures) / self.temperature, labels, reduction="none")


CLASSIFICATION = Classification()
