"""Overhead of a study: a design step compared with its frozen network, fine-tuning compared with bare training.

The frozen network alone takes the same number of captures in the same micro-batches, forward and backward to its input.
Bare training uses one batch already in memory: forward, backward, AdamW. Both compute as a study does, in bfloat16 on
a GPU. Times are between CUDA events on a GPU, and processor times on a CPU.
"""

import math
import statistics
import time
from collections.abc import Callable
from itertools import pairwise

import timing
import timm
import torch
import torch.nn.functional as F
from torch import nn

from tasklens.camera.imaging import PsfCamera
from tasklens.design.criteria import TaskLoss
from tasklens.design.descent import Descent
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import Classifier, frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.recognition.training import fit, parameter_groups
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Constraints, Spec

FIELDS = 9


class Clock(Checkpoint):
    """Record when each step ends, without synchronising a GPU."""

    def __init__(self, device: torch.device):
        super().__init__()
        self.device, self.ends = device, []

    def due(self) -> bool:
        if self.device.type == "cuda":
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self.ends.append(event)
        else:
            self.ends.append(time.process_time())
        return False

    @property
    def steps(self) -> list[float]:
        """Durations [s] of all steps but the first, which ends the warm-up."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            return [a.elapsed_time(b) / 1e3 for a, b in pairwise(self.ends)]
        return [b - a for a, b in pairwise(self.ends)]


def timed(function: Callable[[], object], rounds: int, device: torch.device) -> list[float]:
    """Durations [s] after one round of warm-up."""
    clock = Clock(device)
    for _ in range(rounds + 1):
        function()
        clock.due()
    return clock.steps


def noise(count: int, size: int, device: torch.device) -> ImageDataset:
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, 3, size, size), dtype=torch.uint8, generator=generator)
    return ImageDataset(images, torch.arange(count) % 10, tuple(map(str, range(10))), device)


def design(network: nn.Module, count: int, size: int, rays: int, micro_batch: int, rounds: int, device: torch.device):
    """Durations of a step of task-driven design, and of the frozen network alone on as many captures."""
    dataset = noise(count, size, device)
    classifier = frozen(Classifier(network), dataset.images).to(device)
    problem = Problem(view_of_spec(Spec()), Constraints(), 0, CaptureSettings(), dataset)
    steps = DescentSettings(steps=rounds + 2, pixels=(20, 19))  # no validation before the last step
    settings = GradientDesignSettings(descents=[steps], batch_size=count, rays=rays)
    objective = Objective(TaskLoss(classifier), problem, None, augment=False, micro_batch=micro_batch)
    plates, clock = flat((builtin("COC"), builtin("OKP4")), Spec(), Constraints()), Clock(device)
    descent = Descent(plates, objective, settings, steps, seed=0)
    for step in range(1, rounds + 2):
        descent.step(step)
        clock.due()
    captures, labels = torch.rand(FIELDS * count, 3, size, size, device=device), dataset.labels.to(device)
    labels = labels.repeat(FIELDS)

    def alone() -> None:
        parts = math.ceil(len(captures) / micro_batch)  # as a design does, of one size
        for part, label in zip(captures.chunk(parts), labels.chunk(parts), strict=True):
            part.requires_grad_()
            F.cross_entropy(classifier(part), label).backward()
            part.grad = None

    return clock.steps, timed(alone, rounds, device)


def fine_tuning(network: nn.Module, batch: int, size: int, rounds: int, device: torch.device):
    """Durations of a step of fine-tuning on captures, and of one of bare training."""
    classifier, dataset, clock = Classifier(network).to(device), noise(4 * batch, size, device), Clock(device)
    psf = torch.rand(FIELDS, 3, 51, 51, device=device)
    pipeline = CapturePipeline(PsfCamera(psf / psf.sum((-2, -1), keepdim=True)))
    training = TrainingSettings(epochs=(rounds + 1) / 4, learning_rate=1e-5, batch_size=batch)
    fit(classifier, dataset, training, 0, "fine-tuning", pipeline.one_field, clock)
    images, labels = dataset.batch(torch.arange(batch))
    optimizer = torch.optim.AdamW(parameter_groups(classifier, 0.05), lr=1e-5)
    classifier.train()

    def bare() -> None:
        loss = F.cross_entropy(classifier(images), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return clock.steps, timed(bare, rounds, device)


def peak(device: torch.device) -> str:
    """Largest memory since the last call on a GPU, of the process so far on a CPU [GB]."""
    if device.type != "cuda":
        return f"{timing.peak_memory_gib() * 2**30 / 1e9:.1f}"
    memory = torch.cuda.max_memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    return f"{memory / 1e9:.1f}"


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--models", nargs="+", default=["resnet50"], help="of timm, at 224 pixels")
    options = parser.parse_args(arguments)
    device = claim()
    small = {"layers": [1, 1, 1, 1], "channels": [16, 32, 64, 128], "stem_type": "deep", "stem_width": 16}
    if options.tiny:
        cases = [("resnet18", small, 64, 1, 128, 64)]
    elif device.type == "cuda":
        cases = [(name, {}, 224, 64, 256, 64) for name in options.models]  # the paper's: 576 captures a step
    else:
        cases = [("resnet18", small, 64, 8, 128, 64)]  # the default study's
        cases += [(name, {}, 224, 2, 256, 16) for name in options.models]
    rows = []
    for name, kwargs, size, count, rays, batch in cases:
        for step in ("design", "fine-tuning"):
            network = timm.create_model(name, num_classes=10, **kwargs)
            if step == "design":
                ours, alone = design(network, count, size, rays, batch, options.rounds, device)
            else:
                ours, alone = fine_tuning(network, batch, size, options.rounds, device)
            ratio = statistics.median(ours) / statistics.median(alone)
            load = f"{FIELDS * count} captures" if step == "design" else f"batch of {batch}"
            rows.append(
                (
                    name,
                    f"{step}, {load} of {size} px",
                    timing.spread(ours, 1e3),
                    timing.spread(alone, 1e3),
                    f"{ratio:.3f}",
                    peak(device),
                )
            )
    columns = ("network", "step of", "ours [ms]", "network alone [ms]", "ratio", "peak [GB]")
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    timing.report(f"Networks alone and in a study, {card}", columns, rows, options.save)


if __name__ == "__main__":
    main()
