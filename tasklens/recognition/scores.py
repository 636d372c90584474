"""Scores of segmentation and detection: mean intersection over union, and COCO's average precision."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any, Literal

import numpy
import torch
from torch import Tensor


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
