"""Networks for segmentation and detection learn, judge lenses by their losses, and are scored by their answers."""

from dataclasses import replace
from urllib.error import URLError

import pytest
import torch
from designs import problem
from studies import BOXES, MASKS, SEGMENTATION, TASK_TRAINING
from torch import nn

from tasklens.design.criteria import TaskLoss
from tasklens.design.objective import Objective
from tasklens.recognition import object_scenes, objects, task_networks, training
from tasklens.recognition.object_tasks import Detection, Detections, Segmentation
from tasklens.recognition.objects import ObjectDataset
from tasklens.runtime.errors import InputError
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.task_settings import TaskSettings

OUTPUTS = range(1, 11)  # of the ten textures
NOT_FLIPPED = torch.zeros(2, dtype=torch.bool)


def settings(content: dict) -> TaskSettings:
    return TaskSettings(**content, training=TASK_TRAINING, fine_tuning=TASK_TRAINING)


def data(count: int = 2) -> ObjectDataset:
    return object_scenes.render(count, 32, 0)


class Says(nn.Module):
    """Logits of segmentation that say a class for each pixel."""

    def __init__(self, classes: torch.Tensor, outputs: int):
        super().__init__()
        self.logits = 20 * torch.nn.functional.one_hot(classes, outputs).movedim(-1, 1).float()

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"out": self.logits[: len(images)]}


def test_segmentation_of_a_network_that_knows():
    """Its loss is near zero, and 100 % are right; flipped images have flipped objects."""
    dataset = data()
    task, indices = Segmentation(dataset, OUTPUTS), torch.arange(2)
    truth = torch.stack([objects.semantic(*dataset.objects_of(k)) for k in range(2)])
    knows = Says(truth, 11)
    captures = dataset.as_images().batch(indices)[0]
    assert float(task.loss(knows, captures, indices, NOT_FLIPPED)) < 1e-6
    assert float(task.loss(knows, captures, indices, ~NOT_FLIPPED)) > 1.0
    assert float(task.loss(Says(truth.flip(-1), 11), captures, indices, ~NOT_FLIPPED)) < 1e-6
    assert task.scores(task.answers(knows, captures), indices) == {"miou": 100.0}


def test_detection_of_the_truth_is_perfect():
    """By boxes and by masks; labels of torchvision begin with the background."""
    dataset = data(4)

    def truth(labels, masks):
        answer = {"boxes": objects.boxes(masks), "labels": labels + 1, "scores": torch.ones(len(labels))}
        return answer | {"masks": masks[:, None].float()}

    class Knows(nn.Module):
        def forward(self, images):
            return [truth(*dataset.objects_of(k)) for k in range(len(images))]

    task, indices = Detection(dataset, OUTPUTS, with_masks=True), torch.arange(4)
    answers = task.answers(Knows(), dataset.as_images().batch(indices)[0])
    assert isinstance(answers[0], Detections)
    scores = task.scores(answers, indices)
    assert scores == pytest.approx(dict.fromkeys(("mask_ap", "mask_ap50", "box_ap", "box_ap50"), 100.0))
    assert list(Detection(dataset, OUTPUTS, with_masks=False).scores(answers, indices)) == ["box_ap", "box_ap50"]


def test_objects_of_flipped_images_are_flipped():
    """Boxes and masks for torchvision are flipped from left to right."""
    dataset, batches = data(), []

    class Records(nn.Module):
        def forward(self, images, targets):
            batches.append(targets)
            return {"loss": torch.zeros(())}

    task, indices = Detection(dataset, OUTPUTS, with_masks=True), torch.arange(2)
    for flipped in (NOT_FLIPPED, ~NOT_FLIPPED):
        task.loss(Records(), dataset.as_images().batch(indices)[0], indices, flipped)
    for plain, mirrored in zip(*batches, strict=True):
        left, top, right, bottom = plain["boxes"].T
        assert torch.equal(mirrored["boxes"], torch.stack([32 - right, top, 32 - left, bottom], 1))
        assert torch.equal(mirrored["masks"], plain["masks"].flip(-1))
        assert torch.equal(mirrored["labels"], plain["labels"])


def test_losses_of_segmentation_are_of_each_image():
    dataset = data()
    task, network = Segmentation(dataset, OUTPUTS), Says(torch.zeros(2, 32, 32, dtype=torch.long), 11)
    losses = task.losses(network, dataset.as_images().batch(torch.arange(2))[0], torch.arange(2))
    background = [float((objects.semantic(*dataset.objects_of(k)) == 0).double().mean()) for k in range(2)]
    assert losses.tolist() == pytest.approx([20 * (1 - share) for share in background], rel=1e-4)
    whole = task.loss(network, dataset.as_images().batch(torch.arange(2))[0], torch.arange(2), NOT_FLIPPED)
    assert float(whole) == pytest.approx(float(losses.mean()), rel=1e-6)


def test_a_detector_judges_a_lens_alike_each_time(start):
    """Its random sample of boxes is the same for each lens, and does not change the random numbers of training."""
    torch.manual_seed(0)
    dataset = data(4)
    network = task_networks.frozen(task_networks.build("a", settings(BOXES), 10, 32))
    loss = TaskLoss(network, Detection(dataset, OUTPUTS, with_masks=False))
    judge = Objective(loss, replace(problem(), dataset=dataset.as_images()), None, False, 9)
    before = torch.get_rng_state()
    first = judge.validation_loss(start, 1.0)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(7)
    assert judge.validation_loss(start, 1.0) == first


@pytest.mark.parametrize("content", [SEGMENTATION, BOXES, MASKS], ids=["segmentation", "boxes", "masks"])
def test_losses_have_gradients_at_captures(content):
    """A frozen network passes gradients to captures, for lens design, but not to its own parameters."""
    torch.manual_seed(0)
    dataset = data()
    network = task_networks.frozen(task_networks.build("a", settings(content), 10, 32))
    task = Segmentation(dataset, OUTPUTS) if content is SEGMENTATION else Detection(dataset, OUTPUTS, content is MASKS)
    captures = dataset.as_images().batch(torch.arange(2))[0].requires_grad_()
    task.loss(network, captures, torch.arange(2), NOT_FLIPPED).backward()
    assert captures.grad is not None and captures.grad.isfinite().all() and captures.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in network.parameters())


def test_a_small_network_learns_where_objects_are():
    """Twenty steps of telling objects from background reduce the loss by at least a third."""
    torch.manual_seed(0)
    dataset = data(8)
    network = task_networks.build("a", settings(BOXES), 10, 32)
    task = Detection(dataset, OUTPUTS, with_masks=False)
    fit_settings = TrainingSettings(epochs=20, learning_rate=2e-3, batch_size=8)

    def loss() -> float:
        torch.manual_seed(1)
        network.train()
        indices = torch.arange(8)
        return float(
            task.loss(network, dataset.as_images().batch(indices)[0], indices, torch.zeros(8, dtype=torch.bool))
        )

    before = loss()
    training.fit(network, dataset.as_images(), fit_settings, 0, "test", task=task)
    assert loss() < before / 1.5


def test_whole_networks_of_torchvision():
    """Mask R-CNN of ResNet50 by its name; unknown names and arguments name the task."""
    whole = {"kind": "instance_segmentation", "model": "maskrcnn_resnet50_fpn"}
    network = task_networks.build("a", settings(whole), 3, 64)
    assert network.roi_heads.mask_predictor.mask_fcn_logits.out_channels == 4
    with pytest.raises(InputError, match=r"tasks\.networks\.mine: .*unet"):
        task_networks.build("mine", settings({"kind": "segmentation", "model": "unet"}), 3, 64)
    with pytest.raises(InputError, match=r"tasks\.networks\.mine: resnet19"):
        task_networks.build("mine", settings({"kind": "detection", "backbone": "resnet19"}), 3, 64)


def test_published_weights_know_classes_by_name():
    """From a network with COCO's 90 classes, only the outputs of the data's classes count, in any order."""
    network = settings({"kind": "detection", "model": "fasterrcnn_resnet50_fpn", "pretrained": True})
    outputs = task_networks.outputs("a", network, ("toothbrush", "person"))
    assert outputs == (90, 1)
    with pytest.raises(InputError, match=r"tasks\.networks\.a: .*fasterrcnn_resnet50_fpn have no class stripes"):
        task_networks.outputs("a", network, ("person", "stripes"))

    class Finds(nn.Module):
        def forward(self, images):
            corners = torch.tensor([[0.0, 0, 9, 9]]).repeat(3, 1)
            return [{"boxes": corners, "labels": torch.tensor([1, 2, 90]), "scores": torch.tensor([0.9, 0.8, 0.7])}]

    (detections,) = Detection(data(1), outputs, with_masks=False).answers(Finds(), torch.zeros(1, 3, 32, 32))
    assert detections.labels.tolist() == [1, 0] and detections.scores.tolist() == pytest.approx([0.9, 0.7])


def test_published_weights_that_cannot_be_downloaded_are_one_line(monkeypatch):
    def refused(*arguments, **keywords):
        raise URLError("no route to host")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refused)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", refused)
    network = settings({"kind": "segmentation", "model": "lraspp_mobilenet_v3_large", "pretrained": True})
    with pytest.raises(InputError, match=r"tasks\.networks\.mine: the published weights .* \(no route to host\)"):
        task_networks.build("mine", network, 3, 64)
