"""Training of a task network on sharp images with objects; its fine-tuning and scores on captures of a lens."""

from collections.abc import Sequence
from pathlib import Path

import torch

from tasklens.recognition import object_tasks, objects, task_networks, training
from tasklens.recognition.evaluation import CapturePipeline, scores
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows, write_tensors
from tasklens.settings.task_settings import TaskSettings
from tasklens.study.task_jobs import TaskFineTuningJob


def train(name: str, network: TaskSettings, images: Sequence[Path], weights: Path, checkpoint: Checkpoint) -> None:
    """Train a network on the sharp images, and write its weights."""
    device = claim()
    dataset = objects.read(*images, device=device)
    torch.manual_seed(0)
    model = task_networks.build(name, network, len(dataset.classes), dataset.images.shape[-1]).to(device)
    task = object_tasks.make(name, network, dataset)
    sharp, label = dataset.as_images(), f"training of {name}"
    training.fit(model, sharp, network.training, 0, label, checkpoint=checkpoint, task=task)
    write_tensors(weights, model.state_dict(), {"task": name})


def fine_tune(
    settings: TaskFineTuningJob,
    training_scenes: Sequence[Path],
    test_scenes: Sequence[Path],
    reference: Path,
    psf: Path | None,
    weights: Path,
    metrics: Path,
    checkpoint: Checkpoint,
) -> None:
    """Fine-tune a network on captures of a lens (psf None: sharp images); write weights and scores by field."""
    device = claim()
    training_images, test_images = (objects.read(*split, device=device) for split in (training_scenes, test_scenes))
    size, classes = training_images.images.shape[-1], training_images.classes
    network = task_networks.load(settings.name, settings.network, classes, size, reference).to(device)
    training_pipeline, grading_pipeline = (
        CapturePipeline.of(settings.capture, psf, fields, device) for fields in ("training", "grading")
    )
    training_task, test_task = (
        object_tasks.make(settings.name, settings.network, split) for split in (training_images, test_images)
    )
    test = test_images.as_images()
    rows = [row | {"tuned": False} for row in scores(network, test_task, test, grading_pipeline)]
    training.fit(
        network,
        training_images.as_images(),
        settings.network.fine_tuning,
        settings.seed,
        f"fine-tuning of {settings.name}",
        training_pipeline.one_field,
        checkpoint,
        task=training_task,
    )
    rows += [row | {"tuned": True} for row in scores(network, test_task, test, grading_pipeline)]
    write_tensors(weights, network.state_dict(), {"task": settings.name})
    write_rows(metrics, [settings.columns | row for row in rows])
