"""Segmentation and detection: losses, gradients at captures, answers, networks, and the study of a task."""

from dataclasses import replace
from pathlib import Path
from urllib.error import URLError

import pandas
import pytest
import torch
import yaml
from designs import problem
from examples import changed, read_rows, tiny_study
from pydantic import ValidationError
from rules import finish, job_of
from torch import nn

from tasklens.design.criteria import TaskLoss
from tasklens.design.objective import Objective
from tasklens.materials.catalogues import PLASTICS
from tasklens.optics.io import prescription
from tasklens.recognition import object_scenes, object_splits, objects, task_networks, training
from tasklens.recognition.object_tasks import Detection, Segmentation
from tasklens.recognition.objects import ObjectDataset
from tasklens.recognition.scores import Detections
from tasklens.runtime.errors import InputError
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.task_settings import SceneSettings, TaskSettings
from tasklens.study import claims, table_contents, task_jobs
from tasklens.study.loading import parse
from tasklens.study.report import task_table as report_tasks
from tasklens.study.run.outcome import outcome
from tasklens.study.study import StudyError

TRAINING = {"epochs": 1, "learning_rate": 1e-3, "batch_size": 4}
SEGMENTATION = {"kind": "segmentation", "model": "lraspp_mobilenet_v3_large"}
MASKS = {"kind": "instance_segmentation", "backbone": "resnet18", "channels": 8}
BOXES = MASKS | {"kind": "detection"}
OUTPUTS = range(1, 11)  # of the ten textures
NOT_FLIPPED = torch.zeros(2, dtype=torch.bool)


def settings(content: dict) -> TaskSettings:
    return TaskSettings(**content, training=TRAINING, fine_tuning=TRAINING)


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
    captures = dataset.batch(indices)
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
    answers = task.answers(Knows(), dataset.batch(indices))
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
        task.loss(Records(), dataset.batch(indices), indices, flipped)
    for plain, mirrored in zip(*batches, strict=True):
        left, top, right, bottom = plain["boxes"].T
        assert torch.equal(mirrored["boxes"], torch.stack([32 - right, top, 32 - left, bottom], 1))
        assert torch.equal(mirrored["masks"], plain["masks"].flip(-1))
        assert torch.equal(mirrored["labels"], plain["labels"])


def test_losses_of_segmentation_are_of_each_image():
    dataset = data()
    task, network = Segmentation(dataset, OUTPUTS), Says(torch.zeros(2, 32, 32, dtype=torch.long), 11)
    losses = task.losses(network, dataset.batch(torch.arange(2)), torch.arange(2))
    background = [float((objects.semantic(*dataset.objects_of(k)) == 0).double().mean()) for k in range(2)]
    assert losses.tolist() == pytest.approx([20 * (1 - share) for share in background], rel=1e-4)
    whole = task.loss(network, dataset.batch(torch.arange(2)), torch.arange(2), NOT_FLIPPED)
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


def test_numbers_of_the_table(tmp_path):
    """Means over fields and seeds, the worst field of the means over seeds, tasks in their order."""
    paths = {}
    for seed, gain in ((0, 0.0), (1, 10.0)):
        values = {(False, 0): 20.0, (False, 1): 30.0, (True, 0): 50.0, (True, 1): 40.0}
        common = {"elements": "doublet", "design": "d", "task": "z", "seed": seed, "metric": "miou"}
        rows = [
            common | {"field": field, "value": value + gain * tuned, "tuned": tuned}
            for (tuned, field), value in values.items()
        ]
        path = tmp_path / f"{seed}.csv"
        pandas.DataFrame(rows).to_csv(path, index=False)
        paths[task_jobs.TaskKey("doublet-d", "z", seed)] = path
    (row,) = report_tasks.collect(paths).to_dict("records")
    assert (row["frozen"], row["tuned"], row["worst_field"], row["seeds"]) == (25.0, 50.0, 45.0, 2)


@pytest.mark.parametrize("content", [SEGMENTATION, BOXES, MASKS], ids=["segmentation", "boxes", "masks"])
def test_losses_have_gradients_at_captures(content):
    """A frozen network passes gradients to captures, for lens design, but not to its own parameters."""
    torch.manual_seed(0)
    dataset = data()
    network = task_networks.frozen(task_networks.build("a", settings(content), 10, 32))
    task = Segmentation(dataset, OUTPUTS) if content is SEGMENTATION else Detection(dataset, OUTPUTS, content is MASKS)
    captures = dataset.batch(torch.arange(2)).requires_grad_()
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
        return float(task.loss(network, dataset.batch(indices), indices, torch.zeros(8, dtype=torch.bool)))

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


@pytest.mark.parametrize(
    "content",
    [
        {"kind": "segmentation", "backbone": "resnet18"},
        {"kind": "detection", "backbone": "resnet18", "model": "fasterrcnn_resnet50_fpn"},
        {"kind": "detection", "backbone": "resnet18", "pretrained": True},
        {"kind": "detection", "model": "fasterrcnn_resnet50_fpn", "channels": 32},
        {"kind": "depth", "model": "any"},
    ],
)
def test_networks_that_do_not_fit_their_task(content):
    with pytest.raises(ValidationError):
        settings(content)


def test_splits_have_other_images():
    splits, again = (object_splits.make(SceneSettings(size=32, train=3, test=3)) for _ in range(2))
    assert not torch.equal(splits["train"].images, splits["test"].images)
    assert torch.equal(again["test"].masks, splits["test"].masks)


def test_a_study_of_tasks(tmp_path, monkeypatch):
    """Scenes, networks on sharp images, fine-tuning on captures, and the table; sharp images first."""
    monkeypatch.chdir(tmp_path)
    networks = {"pixels": SEGMENTATION | {"training": TRAINING, "fine_tuning": TRAINING}}
    section = {"scenes": {"size": 32, "train": 8, "test": 4}, "designs": ["imaging1"], "networks": networks}
    study = parse(tiny_study() | {"tasks": section})
    finish("scenes", study)
    finish("images", study)
    for rule in ("design", "psfs"):
        finish(rule, study, lens="singlet-imaging1", seed=0)
    finish("task_reference", study, task="pixels")
    for lens in ("sharp", "singlet-imaging1"):
        paths = finish("task_fine_tune", study, lens=lens, task="pixels", seed=0)
        rows = read_rows(paths.metrics)
        assert {row["field"] for row in rows} == ({"0"} if lens == "sharp" else set(map(str, range(16))))
        assert {row["tuned"] for row in rows} == {"True", "False"}
        assert outcome("task_fine_tune", [*map(str, vars(paths).values())], Path("no.log")).startswith("miou")
    paths = finish("tasks_table", study)
    rows = read_rows(paths.csv)
    assert [(row["task"], row["design"]) for row in rows] == [("pixels", "reference"), ("pixels", "imaging1")]
    assert "Other tasks" in paths.md.read_text()


def test_a_study_without_tasks_has_no_table():
    with pytest.raises(StudyError, match=r"tasks\.networks: expected a task"):
        task_jobs.tasks(parse(tiny_study()))


TASK_DRIVEN = {
    "start": ["imaging1"],
    "task": "boxes",
    "batch_size": 2,
    "rays": 16,
    "augment": False,
    "micro_batch": 18,
    "descents": [{"steps": 2, "centre": "chief_ray"}],
}


def with_tasks(**design) -> dict:
    networks = {"boxes": BOXES | {"training": TRAINING, "fine_tuning": TRAINING}}
    study = tiny_study() | {"tasks": {"scenes": {"size": 32, "train": 8, "test": 4}, "networks": networks}}
    return changed(study, "designs.for_boxes", TASK_DRIVEN | design)


@pytest.mark.slow
def test_a_lens_is_designed_for_detection(tmp_path, monkeypatch, few_rays):
    """By its frozen network, on images with objects, from an imaging lens; it appears only in the tasks' table."""
    monkeypatch.chdir(tmp_path)
    study = parse(with_tasks())
    finish("images", study)
    finish("scenes", study)
    finish("task_reference", study, task="boxes")
    start = finish("design", study, lens="singlet-imaging1", seed=0)
    final = finish("design", study, lens="singlet-for_boxes", seed=0)
    lenses = [prescription.read(paths.lens)[0].lens for paths in (start, final)]
    assert not torch.equal(lenses[0].curvature, lenses[1].curvature)
    assert yaml.safe_load(Path(final.lens).read_text())["origin"]["start"] == "singlet-imaging1"
    assert all("singlet-for_boxes" not in table_contents.table(study, name).lenses for name in study.tables)
    assert task_jobs.tasks(study).lenses[-1] == "singlet-for_boxes"
    assert not any("for_boxes" in lens for claim in claims.claims(study).claims for lens in claim.lenses)


def test_other_fine_tuning_of_a_task_designs_no_lens_again():
    """The frozen network of the design has none."""
    study, other = (parse(changed(with_tasks(), "tasks.networks.boxes.fine_tuning.epochs", n)) for n in (1, 2))
    lens = {"lens": "singlet-for_boxes", "seed": 0}
    for rule, wildcards, same in (("design", lens, True), ("task_fine_tune", lens | {"task": "boxes"}, False)):
        before, after = (job_of(rule, s, **wildcards).settings for s in (study, other))
        assert (before == after) == same


@pytest.mark.parametrize(
    "change, words",
    [
        ({"task": "depth"}, "designs.for_boxes.task: 'depth' is not one of `tasks.networks`: boxes"),
        ({"batch_norm": "batch"}, "expected a frozen network, `batch_norm: stored`"),
        ({"augment": True}, "since masks fit only unchanged images"),
        ({"descents": [{"steps": 2, "size": 16}]}, "since masks fit only unchanged images"),
    ],
)
def test_designs_that_do_not_fit_their_task(change, words):
    with pytest.raises(StudyError, match=words):
        parse(with_tasks(**change))


def test_variants_and_imported_lenses_fit_the_tasks():
    """Variants name their tasks as designs do; the window of an imported lens is smaller than the scenes."""
    variants = {"elements": "singlet", "design": "for_boxes", "variants": {"deep": {"task": "depth"}}}
    with pytest.raises(StudyError, match=r"ablations\.mine\.variants\.deep\.task: 'depth' is not one of"):
        parse(changed(with_tasks(), "ablations.mine", variants))
    phone = {"elements": "phone", "file": str(PLASTICS), "spec": {"kernel_size": 65}}
    study = changed(changed(with_tasks(), "images.size", 64), "imported.phone", phone)
    with pytest.raises(StudyError, match=r"imported\.phone: half of its kernel_size = 65 .* tasks\.scenes\.size = 32"):
        parse(study)
