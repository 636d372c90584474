"""Training loop for networks on sharp images, captures or restored captures."""

import math
from collections.abc import Callable
from typing import Any

import torch
from timm.optim import param_groups_weight_decay
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, LRScheduler, SequentialLR

from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import CLASSIFICATION, Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import send
from tasklens.runtime.progress import Progress
from tasklens.settings.network_settings import TrainingSettings


def warmup_cosine(optimizer: torch.optim.Optimizer, steps: int, warmup: float) -> LRScheduler:
    """Return a schedule with linear warm-up over the fraction `warmup` of the steps, then a cosine to zero."""
    rising = max(1, round(warmup * steps))
    up = LinearLR(optimizer, 1 / (rising + 1), total_iters=rising)
    down = CosineAnnealingLR(optimizer, max(1, steps - rising))
    return SequentialLR(optimizer, [up, down], [rising])


def parameter_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Return the groups for AdamW: biases, norms and what timm's models exempt have no weight decay."""
    exempt = [
        f"{path}.{name}" if path else name
        for path, module in network.named_modules()
        if hasattr(module, "no_weight_decay")
        for name in module.no_weight_decay()
    ]
    return param_groups_weight_decay(network, weight_decay, no_weight_decay_list=exempt)


class Shuffled:
    """Endless batches of indices from successive random permutations of all `count` images."""

    def __init__(self, count: int, batch: int, generator: torch.Generator):
        self.count, self.batch_size, self.generator = count, batch, generator
        self.queue = torch.empty(0, dtype=torch.long)

    def next(self) -> Tensor:
        """Return the next (batch,) indices."""
        while len(self.queue) < self.batch_size:
            self.queue = torch.cat([self.queue, torch.randperm(self.count, generator=self.generator)])
        indices, self.queue = self.queue[: self.batch_size], self.queue[self.batch_size :]
        return indices

    def state_dict(self) -> dict:
        """Return the remaining indices and the state of the generator."""
        return {"queue": self.queue.clone(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """Resume from `state`."""
        self.queue = state["queue"]
        self.generator.set_state(state["generator"])


def fit(
    network: nn.Module,
    dataset: ImageDataset,
    training: TrainingSettings,
    seed: int,
    label: str,
    capture: Callable[[Tensor, torch.Generator], Tensor] = lambda images, generator: images,
    checkpoint: Checkpoint = NO_CHECKPOINT,
    task: Task = CLASSIFICATION,
) -> None:
    """Train a network in place and leave it in `eval()`.

    Args:
        network: network for images (B, 3, H, W) in [0, 1].
        dataset: sharp training images.
        training: settings of the training.
        seed: seed of the image order, the flips and the network's random numbers.
        label: label of progress lines, and name of the part of the checkpoint.
        capture: function that captures the sharp images (B, 3, H, W), with random numbers of the generator.
        checkpoint: checkpoint of the job.
        task: task of the network.

    Raises:
        FloatingPointError: the loss, or a weight after the last step, is not finite.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    steps = max(1, round(training.epochs * len(dataset) / training.batch_size)) if training.epochs else 0
    groups = parameter_groups(network, training.weight_decay)
    optimizer = torch.optim.AdamW(groups, lr=training.learning_rate, fused=True)
    schedule = warmup_cosine(optimizer, steps, training.warmup)
    order = Shuffled(len(dataset), training.batch_size, generator)
    progress = Progress(label, steps)
    part = checkpoint.part(label, network=network, optimizer=optimizer, schedule=schedule, order=order)
    if part.result is not None:
        network.load_state_dict(part.result["network"])
        network.eval()
        return

    def check(step: int, loss: float) -> None:
        if not math.isfinite(loss):
            raise FloatingPointError(
                f"{label}: the loss became {loss} at step {step} of {steps}; lower its learning_rate"
            )
        progress(step, loss=loss)

    before: Tensor | None = None
    network.train()
    for step in range(part.step + 1, steps + 1):
        images, labels = dataset.batch(order.next())
        flip = send(torch.rand(len(images), generator=generator) < 0.5, images.device)
        if before is not None:  # after the images are fetched, which overlaps with the previous step on a GPU
            check(step - 1, before.item())
        images = torch.where(flip[:, None, None, None], images.flip(-1), images)
        loss = task.loss(network, capture(images, generator), labels, flip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        before = loss.detach()
        part.save(step, loss=before)
    if before is not None:
        check(steps, before.item())
    if not all(parameter.isfinite().all() for parameter in network.parameters()):
        raise FloatingPointError(f"{label}: weights are not finite; lower its learning_rate")
    part.finish(network=network.state_dict())
    network.eval()
