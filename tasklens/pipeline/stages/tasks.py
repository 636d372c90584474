"""Training of a task's network on sharp images with objects; its fine-tuning and scores on captures of a lens."""

import torch

from tasklens.imaging import Camera
from tasklens.optics.io import psf_files
from tasklens.recognition import object_tasks, objects, task_networks, training
from tasklens.recognition.evaluation import CapturePipeline, scores
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_rows, write_tensors
from tasklens.study.settings import Slice


def train(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the weights of a network that was trained on the sharp images."""
    device = claim()
    dataset = objects.read(*inputs.train, device=device)
    torch.manual_seed(0)
    network = task_networks.build(settings.name, settings.network, len(dataset.classes), dataset.images.shape[-1]).to(
        device
    )
    task = object_tasks.make(settings.name, settings.network, dataset)
    sharp, label = dataset.as_images(), f"training of {settings.name}"
    training.fit({settings.name: network}, sharp, settings.network.training, 0, label, checkpoint=checkpoint, task=task)
    write_tensors(outputs.weights, network.state_dict(), {"task": settings.name})


def fine_tune(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write weights and scores by field of a network that was fine-tuned on the captures of a lens."""
    device = claim()
    splits = {name: objects.read(*files, device=device) for name, files in inputs.scenes.items()}
    size, classes = splits["train"].images.shape[-1], splits["train"].classes
    network = task_networks.load(settings.name, settings.network, classes, size, inputs.weights).to(device)
    camera = None
    if settings.capture is not None:
        camera = Camera.of(settings.capture, *(tensor.to(device) for tensor in psf_files.read(inputs.psf)))
    pipeline = CapturePipeline(camera)
    tasks = {name: object_tasks.make(settings.name, settings.network, split) for name, split in splits.items()}
    test = splits["test"].as_images()
    rows = [row | {"tuned": False} for row in scores(network, tasks["test"], test, pipeline)]
    training.fit(
        {settings.name: network},
        splits["train"].as_images(),
        settings.network.fine_tuning,
        settings.seed,
        f"fine-tuning of {settings.name}",
        pipeline.one_field,
        checkpoint,
        task=tasks["train"],
    )
    rows += [row | {"tuned": True} for row in scores(network, tasks["test"], test, pipeline)]
    write_tensors(outputs.weights, network.state_dict(), {"task": settings.name})
    write_rows(outputs.metrics, [settings.rows | row for row in rows])
