"""Time of a task-driven step by part (rays and PSFs, captures, network, step), and the share of the optics.

The benchmark times three steps: the default study's in ray space, and the paper's by AdamW with MobileNetV2 and
ResNet50 (random weights, 64 images of 224 px at nine fields). For the paper's steps it times 2 images, and multiplies
times proportional to the captures by 32. The parts are those of `design.descent`; a second run with a trivial network
gives the share of the network. The floor is the time of the network's operations at the speed of a large convolution.
"""

import statistics
import time
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import timing
import timm
import torch
import yaml
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from tasklens.design import least_squares
from tasklens.design.criteria import CaptureCriterion, TaskLoss, loss_at_psf
from tasklens.design.objective import Objective
from tasklens.design.optimizers import OPTIMIZERS
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import Classifier, frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.specification import Constraints, Spec
from tasklens.study.loading import parse

STUDY = Path(__file__).parents[1] / "config" / "config.yaml"
GRADIENT, STEP = "their gradient", "limits and step"
CAPTURES, NETWORK = "captures and their gradient", "network, forward and backward"
OPTICS = ("rays and PSFs", GRADIENT, CAPTURES, STEP)
ORDER = (*OPTICS, "augmentation", NETWORK)


class Average(nn.Module):
    """Ten logits from the mean of an image: a network that costs nothing."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean((1, 2, 3))[:, None] * torch.arange(10.0)


class Clock:
    """Processor times [s] of named parts."""

    def __init__(self):
        self.times: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, part: str):
        begin = time.process_time()
        yield
        self.times[part].append(time.process_time() - begin)


def timed_steps(
    network: nn.Module, kind: str, images: int, timed: int, pixels: int, rays: int, rounds: int
) -> dict[str, float]:
    """Median processor time [s] of each part of a step of a doublet, after one step of warm-up.

    The step, by the optimizer `kind`, has `images` images, of which `timed` are computed; times proportional to the
    captures are scaled.
    """
    dataset = noise(timed, pixels)
    problem = Problem(view_of_spec(Spec()), Constraints(), 0, CaptureSettings(), dataset)
    plates = flat((builtin("COC"), builtin("OKP4")), Spec(), problem.limits)
    quick = LeastSquaresSettings(method="least_squares", starts=6, evaluations=100)
    lens, _ = least_squares.design(plates, problem, quick)  # no ray is lost: lost rays cost time
    settings = DescentSettings(optimizer=kind, steps=rounds + 1, centre="chief_ray")
    optimizer = OPTIMIZERS[kind](lens, problem, settings)
    captures = timed * len(problem.view_of_step(0).fields)
    ours, nothing = TaskLoss(frozen(network, dataset.images)), TaskLoss(Average())
    objective = Objective(ours, problem, None, augment=False, micro_batch=captures, centre=settings.centre)
    indices = torch.arange(timed)

    def at_psf(criterion: CaptureCriterion, grid: torch.Tensor) -> torch.Tensor:
        images, labels = objective.images(indices, augment=False)
        return loss_at_psf(criterion, images, labels, grid, objective.capture, captures)[1]

    for step in range(rounds + 1):
        if step <= 1:
            clock = Clock()  # the first step was the warm-up
        with clock("rays and PSFs"):
            vector = optimizer.vector()
            lens = optimizer.lens(vector)
            _, grid = objective.trace(lens, problem.view_of_step(step), sobol_disc(rays, step), 1.0)
        with clock("augmentation"):
            objective.images(indices, augment=True)
        with clock(CAPTURES):
            at_psf(nothing, grid)
        with clock(NETWORK):
            loss = (grid * at_psf(ours, grid)).sum()
        with clock(GRADIENT):
            torch.autograd.grad(loss, vector, retain_graph=True)
        with clock(STEP):
            optimizer.apply(optimizer.change(vector, lens, loss, 0.0, 1.0))
    middle = {part: statistics.median(times) for part, times in clock.times.items()}
    middle[NETWORK] -= middle[CAPTURES]
    middle[STEP] -= middle[GRADIENT]
    scaled = (NETWORK, CAPTURES, "augmentation")
    return {part: seconds * (images // timed if part in scaled else 1) for part, seconds in middle.items()}


def noise(count: int, size: int) -> ImageDataset:
    """Random images of ten classes."""
    images = torch.randint(0, 256, (count, 3, size, size), dtype=torch.uint8)
    return ImageDataset(images, torch.arange(count) % 10, tuple(map(str, range(10))))


def floor(network: nn.Module, pixels: int, rounds: int) -> float:
    """Least time [s] of a capture in the frozen network, forward and backward, at the speed of a large convolution."""
    network = frozen(network, noise(1, pixels).images)
    image = torch.rand(1, 3, pixels, pixels, requires_grad=True)
    with FlopCounterMode(display=False) as counter:
        network(image).sum().backward()
    features, weights = torch.rand(8, 256, 28, 28), torch.rand(256, 256, 3, 3)
    seconds = []
    with torch.no_grad(), FlopCounterMode(display=False) as large:
        torch.nn.functional.conv2d(features, weights, padding=1)
    for _ in range(rounds + 1):
        begin = time.process_time()
        torch.nn.functional.conv2d(features, weights, padding=1)
        seconds.append(time.process_time() - begin)
    return counter.get_total_flops() * min(seconds) / large.get_total_flops()


def rows_of(times: dict[str, float], captures: int, least: float) -> list[tuple]:
    """Rows of a table: each part per step and per capture, the sums, and the floor of the network."""
    total = sum(times.values())
    parts = [(part, times[part]) for part in ORDER]
    parts += [("**optics**", sum(times[part] for part in OPTICS)), ("**step**", total)]
    parts += [("floor of the network", least * captures)]
    return [(name, f"{1e3 * t:.4g}", f"{1e3 * t / captures:.3g}", f"{100 * t / total:.1f}") for name, t in parts]


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args(arguments)
    columns = ("part", "ms per step", "ms per capture", "% of the step")

    study = parse(yaml.safe_load(STUDY.read_text()))
    supervisor, design = study.classifiers[study.supervisor], study.designs["tasklens"]
    network = Classifier(timm.create_model(supervisor.model, num_classes=10, **supervisor.arguments))
    images = 1 if options.tiny else design.batch_size
    times = timed_steps(network, "ray_space", images, images, study.images.size, design.rays, options.rounds)
    title = f"Default study: {images} images x 9 fields, {supervisor.model}, {study.images.size} px"
    rows = rows_of(times, 9 * images, floor(network, study.images.size, options.rounds))
    timing.report(title, columns, rows, options.save)
    for model in () if options.tiny else ("mobilenetv2_100", "resnet50"):
        network = Classifier(timm.create_model(model, num_classes=10))
        times = timed_steps(network, "adamw", 64, 2, 224, 256, max(1, options.rounds // 3))
        rows = rows_of(times, 576, floor(network, 224, options.rounds))
        timing.report(f"Paper: 64 images x 9 fields, {model}, 224 px", columns, rows, options.save)


if __name__ == "__main__":
    main()
