"""Tasks on images with objects: segmentation, and detection by boxes and masks."""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tasklens.recognition import objects, task_networks
from tasklens.recognition.objects import ObjectDataset
from tasklens.recognition.scores import Detections, average_precision, encode, mean_iou
from tasklens.recognition.tasks import Task
from tasklens.settings.task_settings import TaskSettings

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # normalisation of torchvision's networks


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
