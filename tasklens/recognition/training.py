"""The one training loop for classifiers: sharp images, captures or restored captures."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, LRScheduler, SequentialLR

from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import send
from tasklens.runtime.distributed import SINGLE_PROCESS, ProcessGroup
from tasklens.runtime.progress import Progress
from tasklens.study.settings import TrainingSettings


def parameter_groups(network: nn.Module, weight_decay: float) -> list[dict]:
    """Two groups for AdamW: biases, norms and other vectors are not decayed."""
    matrices = [p for p in network.parameters() if p.requires_grad and p.ndim > 1]
    vectors = [p for p in network.parameters() if p.requires_grad and p.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]


def warmup_cosine(optimizer: torch.optim.Optimizer, steps: int, warmup: float) -> LRScheduler:
    """Linear warm-up over the fraction `warmup` of the steps, then a cosine to zero."""
    rising = max(1, round(warmup * steps))
    up = LinearLR(optimizer, 1 / (rising + 1), total_iters=rising)
    down = CosineAnnealingLR(optimizer, max(1, steps - rising))
    return SequentialLR(optimizer, [up, down], [rising])


class Shuffled:
    """Indices of batches without end: permutations of all `count` images, one after the other, none left out."""

    def __init__(self, count: int, batch: int, generator: torch.Generator):
        self.count, self.batch_size, self.generator = count, batch, generator
        self.queue = torch.empty(0, dtype=torch.long)

    def next(self) -> Tensor:
        """(batch,) indices."""
        while len(self.queue) < self.batch_size:
            self.queue = torch.cat([self.queue, torch.randperm(self.count, generator=self.generator)])
        indices, self.queue = self.queue[: self.batch_size], self.queue[self.batch_size :]
        return indices

    def state_dict(self) -> dict:
        """Where the order stands, and with it the generator."""
        return {"queue": self.queue.clone(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from `state`."""
        self.queue = state["queue"]
        self.generator.set_state(state["generator"])


def reseed(seed: int) -> None:
    """Seed torch's own generator, from which new networks and augmentations draw."""
    torch.manual_seed(seed)


def fit(
    classifier: nn.Module,
    dataset: ImageDataset,
    training: TrainingSettings,
    seed: int,
    label: str,
    see: Callable[[Tensor, torch.Generator, slice], Tensor] = lambda images, generator, share: images[share],
    checkpoint: Checkpoint = NO_CHECKPOINT,
    group: ProcessGroup = SINGLE_PROCESS,
) -> None:
    """Train a classifier in place with cross-entropy; it is left in `eval()`.

    Args:
        classifier: takes images (B, 3, H, W) in [0, 1].
        dataset: the sharp training images.
        training: budget and rates.
        seed: of the order of the images, the flips and the network's own randomness.
        label: for the progress lines.
        see: captures of a share of the sharp images (B, 3, H, W), given a random generator, from which it draws the
            same numbers whatever the share.
        checkpoint: of the job, for its part `label`; the first process writes it.
        group: the processes that train together; all end with the same network.

    Raises:
        FloatingPointError: the loss stopped being finite, or the weights did at the last step.
    """
    share, together = group.share(training.batch_size), group.wrap(classifier)
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    steps = max(1, round(training.epochs * len(dataset) / training.batch_size))
    optimizer = torch.optim.AdamW(
        parameter_groups(classifier, training.weight_decay), lr=training.learning_rate, fused=True
    )
    schedule = warmup_cosine(optimizer, steps, training.warmup)
    order = Shuffled(len(dataset), training.batch_size, generator)
    progress = Progress(label, steps)
    part = checkpoint.part(label, network=classifier, optimizer=optimizer, schedule=schedule, order=order)

    def check(step: int, loss: float) -> None:
        if not math.isfinite(loss):
            raise FloatingPointError(f"{label}: the loss became {loss} at step {step} of {steps}")
        if group.is_first:
            progress(step, loss=loss)

    before = None
    classifier.train()
    for step in range(part.step + 1, steps + 1):
        images, labels = dataset.batch(order.next())
        flip = send(torch.rand(len(images), generator=generator) < 0.5, images.device)
        if before is not None:  # only now, so that a GPU has the step before to compute while images are fetched
            check(step - 1, before.item())
        images = torch.where(flip[:, None, None, None], images.flip(-1), images)
        loss = F.cross_entropy(together(see(images, generator, share)), labels[share])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        before = loss.detach()
        if group.is_first:
            part.save(step, loss=before)
    if before is not None:
        check(steps, before.item())
    if not all(parameter.isfinite().all() for parameter in classifier.parameters()):
        raise FloatingPointError(f"{label}: the weights stopped being finite at step {steps} of {steps}")
    classifier.eval()
