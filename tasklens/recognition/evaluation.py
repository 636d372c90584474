"""Capture pipeline; accuracy of classifiers and scores of other networks on captures by field."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tasklens.imaging import PsfCamera, noise, psnr
from tasklens.recognition.classifiers import Classifier, parameters_m
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import send
from tasklens.runtime.progress import Progress

_WORST = 0.01  # fraction of the images, those with the lowest PSNR, in `worst_psnr_db`
_BATCH = 64  # images per rendering, and captures per forward pass


@dataclass(frozen=True)
class CapturePipeline:
    """Optional camera, then optional restoration, applied to images before a classifier."""

    camera: PsfCamera | None = None
    restoration: nn.Module | None = None

    def one_field(self, images: Tensor, generator: torch.Generator, share: slice = slice(None)) -> Tensor:
        """Return captures of a share of images (B, 3, H, W) in [0, 1], each at a random field, for training."""
        if self.camera is None:
            return self._restored(images[share])
        fields = torch.randint(len(self.camera.psf), (len(images),), generator=generator)
        drawn = None if self.camera.sensor is None else noise(images.shape, generator)[share]
        return self._restored(self.camera.single(images[share], send(fields[share], images.device), drawn))

    def all_fields(self, images: Tensor, batch: int = 0) -> Tensor:
        """Return captures (F, B, 3, H, W) of images (B, 3, H, W) in [0, 1] at all fields; F = 1 without a camera.

        Noise is the same for all lenses; `batch`, a number, makes it differ from that of other batches.
        """
        drawn = torch.Generator().manual_seed(batch)
        captures = images[None] if self.camera is None else self.camera.grid(images, drawn)
        return torch.stack([self._restored(field) for field in captures])

    def _restored(self, captures: Tensor) -> Tensor:
        if self.restoration is None:
            return captures
        with torch.no_grad():
            return self.restoration(captures)


@dataclass(frozen=True)
class Evaluation:
    """Answers of C classifiers to N images at F fields.

    Attributes:
        correct: (C, F, N) whether the classification is correct, bool.
        among_all: (C, F, N) whether it is among all outputs of the network, used or not, bool.
        losses: (C, F, N) cross-entropies.
        psnr_db: (F, N) PSNR of the captures [dB].
    """

    correct: Tensor
    among_all: Tensor
    losses: Tensor
    psnr_db: Tensor


@torch.no_grad()
def evaluate(
    classifiers: Sequence[Callable[[Tensor], Tensor]],
    dataset: ImageDataset,
    pipeline: CapturePipeline,
    label: str = "evaluation",
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Evaluation:
    """Classify all images at all fields; they are captured once for all classifiers.

    Args:
        classifiers: functions from images (B, 3, H, W) to logits (B, C).
        label: label of progress lines, and name of the part of the checkpoint.
        checkpoint: checkpoint of the job.
    """
    part = checkpoint.part(label)
    if part.result is not None:
        return Evaluation(**part.result)
    found = [] if part.state is None else [Evaluation(**part.state)]
    batches = torch.arange(len(dataset)).split(_BATCH)
    progress = Progress(label, len(batches))
    for step, indices in enumerate(batches[part.step :], part.step + 1):
        images, labels = dataset.batch(indices)
        captures = pipeline.all_fields(images, step)
        answers = zip(*(_answers(each, captures, labels) for each in classifiers), strict=True)
        correct, among_all, losses = (torch.stack(each).cpu() for each in answers)
        found.append(Evaluation(correct, among_all, losses, psnr(captures, images).cpu()))
        progress(step)
        if checkpoint.due():
            found = [_joined(found)]
            part.save(step, **vars(found[0]))
    whole = _joined(found)
    part.finish(**vars(whole))
    return whole


def _answers(classifier: Callable[[Tensor], Tensor], captures: Tensor, labels: Tensor) -> tuple[Tensor, ...]:
    """Classify captures (F, B, 3, H, W) with labels (B,).

    Returns:
        Whether each is classified correctly, among the used outputs and among all of the network, and the
        cross-entropies, each (F, B).
    """
    outputs = classifier.outputs if isinstance(classifier, Classifier) else None
    function = classifier.all_outputs if isinstance(classifier, Classifier) else classifier
    logits = torch.stack([torch.cat([function(part) for part in field.split(_BATCH)]) for field in captures])
    among_all = logits.argmax(-1) == (labels if outputs is None else outputs[labels])
    if outputs is not None:
        logits = logits[..., outputs]
    losses = F.cross_entropy(logits.flatten(0, 1), labels.repeat(len(captures)), reduction="none")
    return logits.argmax(-1) == labels, among_all, losses.reshape(logits.shape[:2])


def _joined(found: Sequence[Evaluation]) -> Evaluation:
    """Concatenate the results of batches."""
    return Evaluation(*(torch.cat(values, -1) for values in zip(*(vars(each).values() for each in found), strict=True)))


def zero_shot(classifier: Classifier, before: Evaluation) -> list[dict]:
    """Return the accuracy among all outputs of a network that has more of them than are used.

    Args:
        before: evaluation of the test images before any training.

    Returns:
        Rows (field, metric, value) of `zero_shot_accuracy` [%]; none for a network without other outputs.
    """
    if not classifier.has_more_outputs:
        return []
    values = (100 * before.among_all[0].double().mean(-1)).tolist()
    return [{"field": field, "metric": "zero_shot_accuracy", "value": value} for field, value in enumerate(values)]


@torch.no_grad()
def classify(
    classifier: Callable[[Tensor], Tensor], pipeline: CapturePipeline, images: Tensor, labels: Tensor
) -> tuple[Tensor, Tensor]:
    """Classify images (N, 3, H, W) with labels (N,) at F fields.

    Returns:
        Whether each is classified correctly, (F, N) bool, and the cross-entropy (F, N).
    """
    correct, _, losses = _answers(classifier, pipeline.all_fields(images), labels)
    return correct.cpu(), losses.cpu()


@torch.no_grad()
def scores(network: nn.Module, task: Task, dataset: ImageDataset, pipeline: CapturePipeline) -> list[dict]:
    """Score a network in its task on captures of all images.

    Returns:
        Rows (field, metric, value) of the task's scores; without a camera there is one field.
    """
    network.eval()
    answers: list[list] = []
    batches = torch.arange(len(dataset)).split(_BATCH)
    progress = Progress("scores", len(batches))
    for step, indices in enumerate(batches, 1):
        captures = pipeline.all_fields(dataset.batch(indices)[0], step)
        found = [list(task.answers(network, field)) for field in captures]
        answers = [a + b for a, b in zip(answers, found, strict=True)] if answers else found
        progress(step)
    return [
        {"field": field, "metric": name, "value": value}
        for field, of_field in enumerate(answers)
        for name, value in task.scores(of_field, dataset.labels).items()
    ]


def by_image(values: Tensor, dataset: ImageDataset) -> list[dict]:
    """Return a row per image: its index in the split, its label, and the value of each field.

    Args:
        values: (F, N).
    """
    fields = [f"field{k}" for k in range(len(values))]
    labels = [dataset.classes[label] for label in dataset.labels.tolist()]
    return [
        {"image": i, "label": label} | dict(zip(fields, found, strict=True))
        for i, (label, found) in enumerate(zip(labels, values.T.tolist(), strict=True))
    ]


def measure(
    classifiers: Sequence[Classifier], dataset: ImageDataset, test: Evaluation, minival: Evaluation, captured: bool
) -> list[tuple[list[dict], list[dict]]]:
    """Return accuracies and PSNR of classifiers, as means and by image.

    Args:
        dataset: test images.
        test, minival: evaluations of the classifiers on test and minival images.
        captured: whether the images were captured by a camera; there is no PSNR without one.

    Returns:
        Of each classifier rows (field, metric, value): accuracy [%] on test and minival, PSNR [dB] of all images and of
        the worst 1 %, per field; parameters [millions], and `chance`, the accuracy of guessing [%]. And the rows of
        `by_image` for the test images: 1 if classified correctly, else 0.
    """
    found = []
    for classifier, correct, chosen in zip(classifiers, test.correct, minival.correct, strict=True):
        rows = _metrics(correct, chosen, test.psnr_db if captured else None)
        answers = dataset.classes if classifier.outputs is None else classifier.outputs
        whole = {"parameters_m": parameters_m(classifier), "chance": 100 / len(answers)}
        rows += [{"field": "", "metric": metric, "value": value} for metric, value in whole.items()]
        found.append((rows, by_image(correct.int(), dataset)))
    return found


def _metrics(correct: Tensor, chosen: Tensor, quality: Tensor | None) -> list[dict]:
    """Return the rows of metrics by field from correct test and minival images and the PSNR, each (F, N)."""
    columns = {
        "accuracy": 100 * correct.double().mean(-1),
        "minival_accuracy": 100 * chosen.double().mean(-1),
    }
    if quality is not None:
        columns["psnr_db"] = quality.double().mean(-1)
        columns["worst_psnr_db"] = quality.double().sort(-1).values[:, : math.ceil(_WORST * quality.shape[-1])].mean(-1)
    return [
        {"field": field, "metric": metric, "value": value}
        for metric, values in columns.items()
        for field, value in enumerate(values.tolist())
    ]
