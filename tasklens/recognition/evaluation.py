"""Capture pipeline; accuracy of classifiers and scores of other networks on captures, by field."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.optics.io import psf_files
from tasklens.recognition.classifiers import Classifier, parameters_m
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.settings.capture_settings import CaptureSettings

_WORST = 0.01  # fraction of images with the lowest PSNR, averaged in `worst_psnr_db`
_BATCH = 64  # images per rendering, and captures per forward pass


@dataclass(frozen=True)
class CapturePipeline:
    """Optional camera, then optional restoration, applied to images before a classifier.

    Attributes:
        turns: number of equal parts of the fields; a step of training draws one of them, and in tests image i is
            captured at the fields of part i modulo `turns`.
    """

    camera: PsfCamera | None = None
    restoration: nn.Module | None = None
    turns: int = 1

    @classmethod
    def of(
        cls,
        capture: CaptureSettings | None,
        psf: Path | None,
        fields: str,
        device: torch.device,
        network: nn.Module | None = None,
    ) -> "CapturePipeline":
        """Build the pipeline of a lens from its stored PSFs at a set of fields, and a restoration `network`.

        Args:
            capture: settings of captures; None for sharp images.
        """
        if capture is None:
            return cls(None, network)
        assert psf is not None  # captures need the PSFs of a lens
        grid, light, turns = psf_files.read(psf, fields)
        return cls(PsfCamera.of(capture, grid.to(device), light.to(device)), network, turns)

    def one_field(self, images: Tensor, generator: torch.Generator) -> Tensor:
        """Return captures of images (B, 3, H, W) in [0, 1] at random fields of one part, for training."""
        if self.camera is None:
            return self._restore(images)
        count = len(self.camera.psf) // self.turns
        first = count * int(torch.randint(self.turns, (), generator=generator)) if self.turns > 1 else 0
        fields = first + torch.randint(count, (len(images),), generator=generator)
        pixel_noise = None if self.camera.sensor is None else torch.randn(images.shape, generator=generator)
        return self._restore(self.camera(images, fields, pixel_noise))

    def all_fields(self, images: Tensor, batch: int = 0) -> Tensor:
        """Return captures (F, B, 3, H, W) of images (B, 3, H, W) in [0, 1] at all fields; F = 1 without a camera.

        Noise is the same for all lenses; the number `batch` seeds it, so that batches differ. The first image has the
        first turn: batches of other sizes than multiples of `turns` come last.
        """
        generator = torch.Generator().manual_seed(batch)
        if self.camera is None:
            captures = images[None]
        elif self.turns == 1:
            captures = self.camera.all_fields(images, generator)
        else:
            sets = torch.arange(len(self.camera.psf)).reshape(self.turns, -1)
            captures = images.new_empty(sets.shape[1], *images.shape)
            for turn, fields in enumerate(sets[: len(images)].tolist()):
                captures[:, turn :: self.turns] = self.camera.all_fields(images[turn :: self.turns], generator, fields)
        return torch.stack([self._restore(field) for field in captures])

    def _restore(self, captures: Tensor) -> Tensor:
        if self.restoration is None:
            return captures
        with torch.no_grad():
            return self.restoration(captures)


@dataclass(frozen=True)
class Evaluation:
    """Predictions of a classifier for N images at F fields.

    Attributes:
        correct: (F, N) whether the classification is correct, bool.
        among_all: (F, N) whether it is correct among all outputs of the network, used or not, bool.
        losses: (F, N) cross-entropies.
        psnr_db: (F, N) PSNR of the captures [dB].
    """

    correct: Tensor
    among_all: Tensor
    losses: Tensor
    psnr_db: Tensor


@torch.no_grad()
def evaluate(
    classifier: Callable[[Tensor], Tensor],
    dataset: ImageDataset,
    pipeline: CapturePipeline,
    label: str = "evaluation",
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Evaluation:
    """Classify all images at all fields.

    Args:
        classifier: function from images (B, 3, H, W) to logits (B, C).
        label: label of progress lines, and name of the part of the checkpoint.
        checkpoint: checkpoint of the job.
    """
    part = checkpoint.part(label)
    if part.result is not None:
        return Evaluation(**part.result)
    evaluations = [] if part.state is None else [Evaluation(**part.state)]
    batches = torch.arange(len(dataset)).split(_BATCH)
    progress = Progress(label, len(batches))
    for step, indices in enumerate(batches[part.step :], part.step + 1):
        images, labels = dataset.batch(indices)
        captures = pipeline.all_fields(images, step)
        answers = (*classify(classifier, captures, labels), psnr(captures, images))
        evaluations.append(Evaluation(*(answer.cpu() for answer in answers)))
        progress(step)
        if checkpoint.due():
            evaluations = [_join(evaluations)]
            part.save(step, **vars(evaluations[0]))
    result = _join(evaluations)
    part.finish(**vars(result))
    return result


@torch.no_grad()
def classify(classifier: Callable[[Tensor], Tensor], captures: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Classify captures (F, B, 3, H, W) with labels (B,).

    Returns:
        Whether each capture is classified correctly among the used outputs, whether it is among all outputs of the
        network, and the cross-entropies; all (F, B).
    """
    outputs = classifier.outputs if isinstance(classifier, Classifier) else None
    function = classifier.all_outputs if isinstance(classifier, Classifier) else classifier
    logits = torch.stack([torch.cat([function(part) for part in field.split(_BATCH)]) for field in captures])
    among_all = logits.argmax(-1) == (labels if outputs is None else outputs[labels])
    if outputs is not None:
        logits = logits[..., outputs]
    losses = F.cross_entropy(logits.flatten(0, 1), labels.repeat(len(captures)), reduction="none")
    return logits.argmax(-1) == labels, among_all, losses.reshape(logits.shape[:2])


def _join(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Concatenate the results of batches."""
    return Evaluation(
        *(torch.cat(values, -1) for values in zip(*(vars(part).values() for part in evaluations), strict=True))
    )


def rows(columns: Mapping[str, Tensor]) -> list[dict]:
    """Return rows (field, metric, value) of values (F,) by metric."""
    return [
        {"field": field, "metric": metric, "value": value}
        for metric, values in columns.items()
        for field, value in enumerate(values.tolist())
    ]


@torch.no_grad()
def scores(network: nn.Module, task: Task, dataset: ImageDataset, pipeline: CapturePipeline) -> list[dict]:
    """Score a network at its task on captures of all images.

    Returns:
        Rows (field, metric, value) of the task's scores; one field without a camera.
    """
    network.eval()
    answers: list[list] = []
    batches = torch.arange(len(dataset)).split(_BATCH)
    progress = Progress("scores", len(batches))
    for step, indices in enumerate(batches, 1):
        captures = pipeline.all_fields(dataset.batch(indices)[0], step)
        batch_answers = [list(task.answers(network, field)) for field in captures]
        answers = [a + b for a, b in zip(answers, batch_answers, strict=True)] if answers else batch_answers
        progress(step)
    return [
        {"field": field, "metric": name, "value": value}
        for field, field_answers in enumerate(answers)
        for name, value in task.scores(field_answers, dataset.labels).items()
    ]


def by_image(values: Mapping[str, Tensor], dataset: ImageDataset) -> list[dict]:
    """Return a row per image: its index in the split, its label, and the value at each field.

    Args:
        values: (F, N) by name of the set of fields, with which the names of its columns begin.
    """
    columns = {f"{name}{k}": row.tolist() for name, rows in values.items() for k, row in enumerate(rows)}
    labels = [dataset.classes[label] for label in dataset.labels.tolist()]
    return [
        {"image": i, "label": label} | {name: column[i] for name, column in columns.items()}
        for i, label in enumerate(labels)
    ]


def measure(
    classifier: Classifier, dataset: ImageDataset, test: Mapping[str, Evaluation], minival: Evaluation, captured: bool
) -> list[dict]:
    """Return the accuracy of a classifier and the PSNR of its images.

    Args:
        dataset: test images.
        test: evaluations of the classifier on test images, by the metric of their accuracy.
        minival: its evaluation on minival images.
        captured: whether a camera captured the images; without one there is no PSNR.

    Returns:
        Rows (field, metric, value): accuracy [%] on test and minival, PSNR [dB] of all images and of the worst 1 %, per
        field; parameters [millions], and `chance`, the accuracy of guessing [%].
    """
    evaluations = {**test, "minival_accuracy": minival}
    columns = {metric: 100 * part.correct.double().mean(-1) for metric, part in evaluations.items()}
    if captured:
        psnr_db = test["accuracy"].psnr_db.double()
        sorted_psnr = psnr_db.sort(-1).values
        columns["psnr_db"] = psnr_db.mean(-1)
        columns["worst_psnr_db"] = sorted_psnr[:, : math.ceil(_WORST * sorted_psnr.shape[-1])].mean(-1)
    answers = dataset.classes if classifier.outputs is None else classifier.outputs
    totals = {"parameters_m": parameters_m(classifier), "chance": 100 / len(answers)}
    return rows(columns) + [{"field": "", "metric": metric, "value": value} for metric, value in totals.items()]
