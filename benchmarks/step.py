"""Where the time of a task-driven step goes: rays and PSFs, captures, network; and the optics' share of it.

Two steps: the default study's; and the paper's (ResNet50 with random weights, 64 images of 224 px at nine fields),
in which the network sees 18 of the 576 captures and its time is multiplied by 32. The rest is timed whole. The step is
`descend`'s, taken apart here so that each part can be timed.
"""

import statistics
import time
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import timing
import timm
import torch
import torch.nn.functional as F
import yaml
from torch import nn
from torchvision.transforms.v2 import TrivialAugmentWide

from tasklens.design import least_squares
from tasklens.design.constraints import penalty
from tasklens.design.start import Variables, flat, parameter_groups
from tasklens.imaging import Camera
from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import trace_fields
from tasklens.optics.psf import psf
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import Classifier, frozen
from tasklens.study.design_settings import LearningRates, LeastSquaresSettings
from tasklens.study.settings import Constraints, Spec
from tasklens.study.study import parse

STUDY = Path(__file__).parents[1] / "config" / "config.yaml"
OPTICS = ("rays, PSFs, limits", "their backward", "captures", "captures, backward")
NETWORK = "network, forward and backward"
ORDER = (*OPTICS, "augmentation", NETWORK, "optimiser")


class Clock:
    """Processor times [s] of named parts."""

    def __init__(self):
        self.times: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, part: str):
        begin = time.process_time()
        yield
        self.times[part].append(time.process_time() - begin)


def timed_steps(network: nn.Module, dataset: int, pixels: int, rays: int, judged: int, rounds: int) -> dict[str, float]:
    """Median processor time [s] of each part of a step of a doublet, after one step of warm-up.

    The network sees `judged` captures, which divide their number; its time is scaled to all of them.
    """
    looks, limits = view_of_spec(Spec()), Constraints()
    classifier = frozen(Classifier(network))
    plates = flat((builtin("COC"), builtin("OKP4")), Spec(), limits)
    quick = LeastSquaresSettings(method="least_squares", starts=6, evaluations=100)
    lens = least_squares.design(plates, looks, limits, quick, 0, [])  # no ray is lost: lost ones cost time
    variables, rates = Variables.stepped(lens, looks, LearningRates()), LearningRates()
    values = {name: value.requires_grad_() for name, value in variables.values().items()}
    optimizer = torch.optim.AdamW(parameter_groups(values, rates))
    sharp = torch.randint(0, 256, (dataset, 3, pixels, pixels), dtype=torch.uint8)
    repeats = dataset * len(looks.fields) // judged
    labels = torch.zeros(judged, dtype=torch.long)
    augment = TrivialAugmentWide()
    for step in range(rounds + 1):
        if step <= 1:
            clock = Clock()  # the first step was the warm-up
        with clock("rays, PSFs, limits"):
            lens = variables.assemble(values)
            traced = trace_fields(lens, looks, sobol_disc(rays, step))
            grid = psf(traced, looks.fields, looks.pixel_pitch, looks.kernel_size)
            bounds = penalty(lens, limits, looks)
        with clock("augmentation"):
            images = torch.stack([augment(image) for image in sharp]).float() / 255
        leaf = grid.detach().float().requires_grad_()
        with clock("captures"):
            captures = Camera(leaf).grid(images)
        seen = captures.detach().flatten(0, 1)[:judged].requires_grad_()
        with clock(NETWORK):
            F.cross_entropy(classifier(seen), labels).backward()
        upstream = seen.grad.repeat(repeats, 1, 1, 1).reshape(captures.shape)
        with clock("captures, backward"):
            captures.backward(upstream)
        with clock("their backward"):
            optimizer.zero_grad()
            torch.autograd.backward([grid, bounds], [leaf.grad.to(grid.dtype), None])
        with clock("optimiser"):
            optimizer.step()
    middle = {part: statistics.median(times) for part, times in clock.times.items()}
    return middle | {NETWORK: middle[NETWORK] * repeats}


def rows_of(times: dict[str, float], captures: int) -> list[tuple]:
    """Rows of a table: each part per step and per capture, and the sums."""
    total = sum(times.values())
    parts = [(part, times[part]) for part in ORDER]
    parts += [("**optics**", sum(times[part] for part in OPTICS)), ("**step**", total)]
    return [(name, f"{1e3 * t:.4g}", f"{1e3 * t / captures:.3g}", f"{100 * t / total:.1f}") for name, t in parts]


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args(arguments)
    columns = ("part", "ms per step", "ms per capture", "% of the step")

    study = parse(yaml.safe_load(STUDY.read_text()))
    supervisor, design = study.classifiers[study.supervisor], study.designs["tasklens"]
    network = timm.create_model(supervisor.model, num_classes=10, **supervisor.arguments)
    dataset = 1 if options.tiny else design.images
    times = timed_steps(network, dataset, study.images.size, design.rays, 9 * dataset, options.rounds)
    title = f"Default study: {dataset} images x 9 fields, {supervisor.model}, {study.images.size} px"
    timing.report(title, columns, rows_of(times, 9 * dataset), options.save)
    if not options.tiny:
        times = timed_steps(timm.create_model("resnet50"), 64, 224, 256, 18, max(1, options.rounds // 3))
        timing.report("Paper: 64 images x 9 fields, ResNet50, 224 px", columns, rows_of(times, 576), options.save)


if __name__ == "__main__":
    main()
