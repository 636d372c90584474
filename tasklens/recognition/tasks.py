"""Tasks on images with objects: the loss of a network, its answers, and their scores."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tasklens.recognition import objects
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.recognition.objects import ObjectDataset
from tasklens.recognition.scores import Detections, average_precision, mean_iou
from tasklens.runtime.progress import Progress
from tasklens.study.task_settings import TaskSettings

_BATCH = 32  # images whose captures are scored at once
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of torchvision's networks


class Task(ABC):
    """A task of networks on the captures of a data set's images.

    Args:
        dataset: images with objects.
    """

    def __init__(self, dataset: ObjectDataset):
        self.dataset = dataset

    @abstractmethod
    def loss(self, network: nn.Module, captures: Tensor, indices: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean loss of captures (B, 3, H, W) of the images `indices` (B,), some `flipped` left to right."""

    @abstractmethod
    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Any]:
        """Return the answer for each capture, on the CPU."""

    @abstractmethod
    def scores(self, answers: Sequence[Any], indices: Tensor) -> Mapping[str, float]:
        """Return the scores [%] of answers for the images `indices` by name; the first is the one that counts."""

    def masks(self, index: int, flipped: bool) -> tuple[Tensor, Tensor]:
        """Return the labels (K,) and masks (K, H, W) of the objects of an image."""
        labels, masks = self.dataset.of(index)
        return labels, masks.flip(-1) if flipped else masks


class Segmentation(Task):
    """The class of each pixel, background among them; scored by mean intersection over union."""

    def loss(self, network: nn.Module, captures: Tensor, indices: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean cross-entropy of all pixels."""
        pairs = zip(indices.tolist(), flipped.tolist(), strict=True)
        wanted = torch.stack([objects.semantic(*self.masks(*pair)) for pair in pairs]).to(captures.device)
        return F.cross_entropy(_logits(network, captures), wanted)

    @torch.no_grad()
    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Tensor]:
        """Return the likeliest class (H, W) of each pixel."""
        return list(_logits(network, captures).argmax(1).cpu())

    def scores(self, answers: Sequence[Tensor], indices: Tensor) -> Mapping[str, float]:
        """Return `miou` [%]."""
        wanted = torch.stack([objects.semantic(*self.masks(k, False)) for k in indices.tolist()])
        return {"miou": mean_iou(torch.stack(list(answers)), wanted, 1 + len(self.dataset.classes))}


def _logits(network: nn.Module, captures: Tensor) -> Tensor:
    """Return torchvision's logits (B, C, H, W) of captures in [0, 1]."""
    mean, std = (torch.tensor(v, device=captures.device)[:, None, None] for v in (_MEAN, _STD))
    return network((captures - mean) / std)["out"]


class Detection(Task):
    """Boxes of objects, and their masks if the network finds masks; scored by COCO's average precision."""

    def __init__(self, dataset: ObjectDataset, with_masks: bool):
        super().__init__(dataset)
        self.with_masks = with_masks

    def loss(self, network: nn.Module, captures: Tensor, indices: Tensor, flipped: Tensor) -> Tensor:
        """Compute the sum of torchvision's losses; the network is in `train()`, or gives none."""
        targets = []
        for index, flip in zip(indices.tolist(), flipped.tolist(), strict=True):
            labels, masks = self.masks(index, flip)
            target = {"boxes": objects.boxes(masks), "labels": 1 + labels, "masks": masks.byte()}
            targets.append({name: value.to(captures.device) for name, value in target.items()})
        return torch.stack(list(network(list(captures), targets).values())).sum()

    @torch.no_grad()
    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Detections]:
        """Return the objects that are found; the network is in `eval()`."""
        found = []
        for answer in network(list(captures)):
            masks = (answer["masks"][:, 0] > 0.5).cpu() if self.with_masks else None
            boxes, labels, scores = (answer[name].cpu() for name in ("boxes", "labels", "scores"))
            found.append(Detections(boxes, labels - 1, scores, masks))
        return found

    def scores(self, answers: Sequence[Detections], indices: Tensor) -> Mapping[str, float]:
        """Return `box_ap`, `box_ap50`, and of masks `mask_ap`, `mask_ap50` [%]; masks first."""
        true = []
        for index in indices.tolist():
            labels, masks = self.dataset.of(index)
            true.append(Detections(objects.boxes(masks), labels, None, masks))
        classes = len(self.dataset.classes)
        found: dict[str, float] = {}
        for by in ("mask", "box") if self.with_masks else ("box",):
            found |= {f"{by}_{name}": v for name, v in average_precision(answers, true, classes, by).items()}
        return found


def make(settings: TaskSettings, dataset: ObjectDataset) -> Task:
    """Return the task on a data set."""
    if settings.kind == "segmentation":
        return Segmentation(dataset)
    return Detection(dataset, with_masks=settings.kind == "instance_segmentation")


@torch.no_grad()
def evaluate(network: nn.Module, task: Task, pipeline: CapturePipeline) -> list[dict]:
    """Return rows (field, metric, value) of the scores of all captures at each field; without a camera there is one."""
    network.eval()
    every = torch.arange(len(task.dataset))
    answers: list[list] = []
    batches = every.split(_BATCH)
    progress = Progress("scores", len(batches))
    for step, indices in enumerate(batches, 1):
        captures = pipeline.all_fields(task.dataset.batch(indices))
        found = [list(task.answers(network, field)) for field in captures]
        answers = [a + b for a, b in zip(answers, found, strict=True)] if answers else found
        progress(step)
    return [
        {"field": field, "metric": name, "value": value}
        for field, of_field in enumerate(answers)
        for name, value in task.scores(of_field, every).items()
    ]
