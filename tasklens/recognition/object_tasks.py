"""Tasks on images with objects, and their scores: segmentation, and detection by boxes and masks."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any, Literal

import numpy
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tasklens.recognition import objects, task_networks
from tasklens.recognition.objects import ObjectDataset
from tasklens.recognition.tasks import Task
from tasklens.settings.task_settings import TaskSettings

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # normalisation of torchvision's networks


@dataclass(frozen=True)
class Detections:
    """Objects of one image, detected or true, on the CPU.

    Attributes:
        boxes: (K, 4) left, top, right, bottom edge [pixels].
        labels: (K,) classes.
        scores: (K,) confidence; None for true objects.
        masks: (K,) run lengths of the masks, from `encode`; None if there are no masks.
    """

    boxes: Tensor
    labels: Tensor
    scores: Tensor | None = None
    masks: Sequence[Mapping[str, Any]] | None = None


class ObjectTask(Task):
    """A task on the objects of images.

    Args:
        dataset: images with objects; labels are the indices of its images, as in `as_images`.
        outputs: network output of each class; output 0 is the background.
    """

    def __init__(self, dataset: ObjectDataset, outputs: Sequence[int]):
        self.dataset, self.outputs = dataset, tuple(outputs)

    def masks(self, index: int, flipped: bool) -> tuple[Tensor, Tensor]:
        """Return the labels (K,) and masks (K, H, W) of the objects of an image."""
        labels, masks = self.dataset.objects_of(index)
        return labels, masks.flip(-1) if flipped else masks


class Segmentation(ObjectTask):
    """Classification of each pixel, including the background; scored by mean intersection over union."""

    def loss(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Compute the mean cross-entropy of all pixels."""
        return self._each(network, captures, labels, flipped).mean()

    def losses(self, network: nn.Module, captures: Tensor, labels: Tensor) -> Tensor:
        """Compute the mean cross-entropy (N,) of the pixels of each capture."""
        return self._each(network, captures, labels, torch.zeros_like(labels, dtype=torch.bool))

    def _each(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        pairs = zip(labels.tolist(), flipped.tolist(), strict=True)
        targets = torch.stack([objects.semantic(*self.masks(*pair)) for pair in pairs]).to(captures.device)
        return F.cross_entropy(self._logits(network, captures), targets, reduction="none").mean((1, 2))

    @torch.no_grad()
    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Tensor]:
        """Return the most likely class (H, W) of each pixel, uint8."""
        return list(self._logits(network, captures).argmax(1).byte().cpu())

    def scores(self, answers: Sequence[Tensor], labels: Tensor) -> Mapping[str, float]:
        """Return `miou` [%]."""
        truth = (objects.semantic(*self.masks(k, False)) for k in labels.tolist())
        return {"miou": mean_iou(answers, truth, 1 + len(self.dataset.classes))}

    def _logits(self, network: nn.Module, captures: Tensor) -> Tensor:
        """Return the logits (B, 1 + C, H, W) of background and classes for captures in [0, 1]."""
        mean, std = (torch.tensor(v, device=captures.device)[:, None, None] for v in (_MEAN, _STD))
        return network((captures - mean) / std)["out"][:, [0, *self.outputs]]


class Detection(ObjectTask):
    """Detection of boxes, and of masks if the network predicts them; scored by COCO's average precision."""

    def __init__(self, dataset: ObjectDataset, outputs: Sequence[int], with_masks: bool):
        super().__init__(dataset, outputs)
        self.with_masks = with_masks

    def loss(self, network: nn.Module, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Compute the sum of torchvision's losses; the network must be in `train()` to return them."""
        targets = []
        for index, flip in zip(labels.tolist(), flipped.tolist(), strict=True):
            classes, masks = self.masks(index, flip)
            target = {
                "boxes": objects.boxes(masks),
                "labels": torch.tensor(self.outputs)[classes],
                "masks": masks.byte(),
            }
            targets.append({name: value.to(captures.device) for name, value in target.items()})
        return torch.stack(list(network(list(captures), targets).values())).sum()

    @torch.no_grad()
    def answers(self, network: nn.Module, captures: Tensor) -> Sequence[Detections]:
        """Return the detected objects; the network is in `eval()`."""
        detections, class_outputs = [], torch.tensor(self.outputs)
        for answer in network(list(captures)):
            masks = (answer["masks"][:, 0] > 0.5).cpu() if self.with_masks else None
            boxes, labels, scores = (answer[name].cpu() for name in ("boxes", "labels", "scores"))
            is_class = labels[:, None] == class_outputs
            in_set = is_class.any(1)  # published networks have other classes too
            classes = is_class[in_set].int().argmax(1)
            detections.append(
                Detections(boxes[in_set], classes, scores[in_set], None if masks is None else encode(masks[in_set]))
            )
        return detections

    def scores(self, answers: Sequence[Detections], labels: Tensor) -> Mapping[str, float]:
        """Return `mask_ap` and `mask_ap50` if there are masks, then `box_ap` and `box_ap50` [%]."""
        truth = []
        for index in labels.tolist():
            classes, masks = self.dataset.objects_of(index)
            truth.append(Detections(objects.boxes(masks), classes, None, encode(masks)))
        values: dict[str, float] = {}
        for by in ("mask", "box") if self.with_masks else ("box",):
            values |= {
                f"{by}_{name}": v
                for name, v in average_precision(answers, truth, len(self.dataset.classes), by).items()
            }
        return values


def make(name: str, settings: TaskSettings, dataset: ObjectDataset) -> Task:
    """Return the task `name` on a data set; raises InputError if published weights lack one of its classes."""
    outputs = task_networks.outputs(name, settings, dataset.classes)
    if settings.kind == "segmentation":
        return Segmentation(dataset, outputs)
    return Detection(dataset, outputs, with_masks=settings.kind == "instance_segmentation")


def mean_iou(answers: Iterable[Tensor], truth: Iterable[Tensor], classes: int) -> float:
    """Compute the mean over classes of intersection over union [%]; absent classes are omitted.

    Args:
        answers, truth: predicted and true class of each pixel of each image, 0 to `classes` - 1.
        classes: number of classes, including the background.
    """
    pairs = torch.zeros(classes**2, dtype=torch.double)
    for answer, target in zip(answers, truth, strict=True):
        pairs += torch.bincount((target.long() * classes + answer.long()).flatten(), minlength=classes**2)
    pairs = pairs.reshape(classes, classes)
    both, union = pairs.diagonal(), pairs.sum(0) + pairs.sum(1) - pairs.diagonal()
    return 100 * float((both[union > 0] / union[union > 0]).mean())


def encode(masks: Tensor) -> list[dict[str, Any]]:
    """Encode masks (K, H, W) bool as run lengths with pycocotools: a hundredth of the memory."""
    from pycocotools import mask as encoding

    columns = numpy.asfortranarray(masks.permute(1, 2, 0).numpy().astype("uint8"))
    return encoding.encode(columns) if len(masks) else []


def average_precision(
    detections: Sequence[Detections], true: Sequence[Detections], classes: int, by: Literal["box", "mask"]
) -> dict[str, float]:
    """Compute COCO's average precision [%] with pycocotools: over IoU of 0.5 to 0.95 (`ap`), and at 0.5 (`ap50`).

    Args:
        detections, true: detected and true objects of each image.
        classes: number of classes, without the background.
        by: whether overlaps are between boxes or between masks.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    def entries(images: Sequence[Detections]) -> list[dict[str, Any]]:
        return [
            entry | {"id": number}
            for number, entry in enumerate(
                (entry for k, image in enumerate(images) for entry in _entries(image, k, by)), 1
            )
        ]

    with redirect_stdout(StringIO()):  # pycocotools prints its progress
        truth, answer = COCO(), COCO()
        common = {
            "images": [{"id": k, "height": 0, "width": 0} for k in range(len(true))],  # encoded masks have sizes
            "categories": [{"id": label} for label in range(classes)],
        }
        truth.dataset = common | {"annotations": entries(true)}
        answer.dataset = common | {"annotations": entries(detections)}
        truth.createIndex()
        answer.createIndex()
        evaluation = COCOeval(truth, answer, "bbox" if by == "box" else "segm")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return {"ap": 100 * max(0.0, float(evaluation.stats[0])), "ap50": 100 * max(0.0, float(evaluation.stats[1]))}


def _entries(image: Detections, number: int, by: str) -> list[dict[str, Any]]:
    """Return the objects of an image as COCO's annotations."""
    from pycocotools import mask as encoding

    rows = []
    for k in range(len(image.labels)):
        left, top, right, bottom = image.boxes[k].tolist()
        row: dict[str, Any] = {
            "image_id": number,
            "category_id": int(image.labels[k]),
            "bbox": [left, top, right - left, bottom - top],
            "area": (right - left) * (bottom - top),
            "iscrowd": 0,
        }
        if image.scores is not None:
            row["score"] = float(image.scores[k])
        if by == "mask":
            assert image.masks is not None  # by = "mask" needs masks
            row["segmentation"] = image.masks[k]
            row["area"] = float(encoding.area(image.masks[k]))
        rows.append(row)
    return rows
