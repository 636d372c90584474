"""Training loop for networks on sharp images, captures or restored captures."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, LRScheduler, SequentialLR

from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import CLASSIFICATION, Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import random_state, send, set_random_state
from tasklens.runtime.distributed import SINGLE_PROCESS, ProcessGroup
from tasklens.runtime.progress import Progress
from tasklens.study.settings import TrainingSettings


def parameter_groups(network: nn.Module, weight_decay: float) -> list[dict]:
    """Return two parameter groups for AdamW: biases, norms and other vectors have no weight decay."""
    matrices = [p for p in network.parameters() if p.requires_grad and p.ndim > 1]
    vectors = [p for p in network.parameters() if p.requires_grad and p.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]


def warmup_cosine(optimizer: torch.optim.Optimizer, steps: int, warmup: float) -> LRScheduler:
    """Return a schedule with linear warm-up over the fraction `warmup` of the steps, then a cosine to zero."""
    rising = max(1, round(warmup * steps))
    up = LinearLR(optimizer, 1 / (rising + 1), total_iters=rising)
    down = CosineAnnealingLR(optimizer, max(1, steps - rising))
    return SequentialLR(optimizer, [up, down], [rising])


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
    networks: Mapping[str, nn.Module],
    dataset: ImageDataset,
    training: TrainingSettings,
    seed: int,
    label: str,
    capture: Callable[[Tensor, torch.Generator, slice], Tensor] = lambda images, generator, share: images[share],
    checkpoint: Checkpoint = NO_CHECKPOINT,
    group: ProcessGroup = SINGLE_PROCESS,
    task: Task = CLASSIFICATION,
) -> None:
    """Train networks in place and independently, on the same captures; leave them in `eval()`.

    Args:
        networks: by name, networks for images (B, 3, H, W) in [0, 1].
        dataset: sharp training images.
        training: settings of the training.
        seed: seed of the image order, the flips and the networks' random numbers.
        label: label of progress lines, and name of the part of the checkpoint.
        capture: function that captures a share of the sharp images (B, 3, H, W); it must draw the same random
            numbers from the generator for every share.
        checkpoint: checkpoint of the job; the first process saves it.
        group: process group; all processes end with the same networks.
        task: task of the networks.

    Raises:
        FloatingPointError: the loss, or a weight after the last step, is not finite.
    """
    share = group.share(training.batch_size)
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    steps = max(1, round(training.epochs * len(dataset) / training.batch_size)) if training.epochs else 0
    trainees = {name: _Trainee(network, training, steps, group) for name, network in networks.items()}
    order = Shuffled(len(dataset), training.batch_size, generator)
    progress = Progress(label, steps)
    part = checkpoint.part(label, order=order, **{f"trainee {name}": holder for name, holder in trainees.items()})
    if part.result is not None:
        for name, network in networks.items():
            network.load_state_dict(part.result["networks"][name])
            network.eval()
        return

    def check(step: int, losses: Mapping[str, Tensor]) -> None:
        values = {name: loss.item() for name, loss in losses.items()}
        for name, loss in values.items():
            if not math.isfinite(loss):
                raise FloatingPointError(
                    f"{label}: the loss of {name} became {loss} at step {step} of {steps}; lower its learning_rate"
                )
        if group.is_first:
            progress(step, **{f"loss {name}" if len(values) > 1 else "loss": loss for name, loss in values.items()})

    before: dict[str, Tensor] = {}
    for network in networks.values():
        network.train()
    for step in range(part.step + 1, steps + 1):
        images, labels = dataset.batch(order.next())
        flip = send(torch.rand(len(images), generator=generator) < 0.5, images.device)
        if before:  # after the images are fetched, which overlaps with the previous step on a GPU
            check(step - 1, before)
        images = torch.where(flip[:, None, None, None], images.flip(-1), images)
        captures = capture(images, generator, share)
        before = {name: trainee.step(task, captures, labels[share], flip[share]) for name, trainee in trainees.items()}
        if group.is_first:
            part.save(step, losses=before)
    if before:
        check(steps, before)
    for name, network in networks.items():
        if not all(parameter.isfinite().all() for parameter in network.parameters()):
            raise FloatingPointError(
                f"{label}: the weights of {name} stopped being finite at step {steps} of {steps}; "
                "lower its learning_rate"
            )
    if group.is_first:
        part.finish(networks={name: network.state_dict() for name, network in networks.items()})
    for network in networks.values():
        network.eval()


class _Trainee:
    """A network with its optimizer, schedule and random state (for dropout, for example)."""

    def __init__(self, network: nn.Module, training: TrainingSettings, steps: int, group: ProcessGroup):
        self.parallel = group.wrap(network)
        groups = parameter_groups(network, training.weight_decay)
        self.optimizer = torch.optim.AdamW(groups, lr=training.learning_rate, fused=True)
        self.schedule = warmup_cosine(self.optimizer, steps, training.warmup)
        self.holders: dict[str, Any] = {"network": network, "optimizer": self.optimizer, "schedule": self.schedule}
        self.random = random_state()

    def step(self, task: Task, captures: Tensor, labels: Tensor, flipped: Tensor) -> Tensor:
        """Take one step; return the loss before the step."""
        set_random_state(self.random)
        loss = task.loss(self.parallel, captures, labels, flipped)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.random = random_state()
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the network, optimizer, schedule and random generators."""
        return {name: holder.state_dict() for name, holder in self.holders.items()} | {"random": self.random}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from saved states."""
        for name, holder in self.holders.items():
            holder.load_state_dict(state[name])
        self.random = state["random"]
