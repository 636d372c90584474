"""Growth of resident memory in an hour of task-driven design and of fine-tuning, each in a process of its own.

Jobs like those of the default study (64 pixels, several lenses, validations, checkpoints on disk, the jobs' malloc
settings) follow each other until the time is up. The growth is the change of the median from a sixth of the time after
the first minutes to the last sixth. The target is 2 %.
"""

import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

import psutil
import timing
import timm
import torch

from tasklens.camera.imaging import PsfCamera
from tasklens.design import descents
from tasklens.design.criteria import TaskLoss
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import Classifier, frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.recognition.training import fit
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.job import keep_memory
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Constraints, Spec

NETWORK = {"layers": [1, 1, 1, 1], "channels": [16, 32, 64, 128], "stem_type": "deep", "stem_width": 16}
STEPS = 1000  # of a job: some minutes


class TimeUp(Exception):
    """The minutes of a job are over."""


class Timed(Checkpoint):
    """A checkpoint on the disk whose job ends at a time."""

    def __init__(self, path: Path, end: float):
        super().__init__(path)
        self.end = end

    def due(self) -> bool:
        if time.monotonic() > self.end:
            raise TimeUp
        return super().due()


def noise(tiny: bool) -> ImageDataset:
    """As many images as the smallest studies train with, in ten classes."""
    number, size = (20, 32) if tiny else (2000, 64)
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (number, 3, size, size), dtype=torch.uint8, generator=generator)
    return ImageDataset(images, torch.arange(len(images)) % 10, tuple(map(str, range(10))))


def design(steps: int, tiny: bool, checkpoint: Checkpoint) -> None:
    """Task-driven design by a frozen network: a short descent of two lenses, and one with all other steps."""
    dataset, spec, limits = noise(tiny), Spec(), Constraints()
    classifier = frozen(Classifier(timm.create_model("resnet18", num_classes=10, **NETWORK)), dataset.images)
    problem = Problem(view_of_spec(spec), limits, 0, CaptureSettings(), dataset)
    first = max(1, steps // 40)
    parts = [
        DescentSettings(steps=first, lenses=2, pixels=(20, 5)),
        DescentSettings(steps=steps - 2 * first, pixels=(5, 1), duration=0.5),
    ]
    settings = GradientDesignSettings(descents=parts, batch_size=1 if tiny else 8, rays=128)
    plates = flat((builtin("COC"), builtin("OKP4")), spec, limits)
    descents.design(plates, {}, lambda part: TaskLoss(classifier), problem, settings, checkpoint)


def fine_tuning(steps: int, tiny: bool, checkpoint: Checkpoint) -> None:
    """Training of the network on captures of one field each."""
    dataset, batch = noise(tiny), 4 if tiny else 64
    network = Classifier(timm.create_model("resnet18", num_classes=10, **NETWORK))
    psf = torch.rand(9, 3, 51, 51)
    pipeline = CapturePipeline(PsfCamera(psf / psf.sum((-2, -1), keepdim=True)))
    training = TrainingSettings(epochs=steps * batch / len(dataset), learning_rate=1e-5, batch_size=batch)
    fit(network, dataset, training, 0, "fine-tuning", pipeline.one_field, checkpoint)


def work(job: Callable[[int, bool, Checkpoint], None], minutes: float, tiny: bool) -> None:
    """Run a job for so many minutes, again from the beginning if it ends earlier; in a separate process."""
    keep_memory()
    end = time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory() as folder, suppress(TimeUp):
        for number in count():
            job(6 if tiny else STEPS, tiny, Timed(Path(folder, f"{number}.pt"), end))


def sampled(job: Callable, minutes: float, tiny: bool, every: float) -> list[tuple[float, float]]:
    """Time since its start [min] and resident memory [MB] of a job's process, every so many seconds."""
    process = multiprocessing.get_context("spawn").Process(target=work, args=(job, minutes, tiny))
    begin, samples = time.monotonic(), []
    process.start()
    watched = psutil.Process(process.pid)
    while process.exitcode is None:
        process.join(every)
        if process.exitcode is None:
            samples.append(((time.monotonic() - begin) / 60, watched.memory_info().rss / 1e6))
    if process.exitcode:
        raise RuntimeError(f"{job.__name__}: its process ended with {process.exitcode}")
    return samples


def growth(samples: list[tuple[float, float]], first: float) -> tuple[float, float]:
    """Medians [MB] of a sixth of the time after the `first` minutes, and of the last sixth."""
    width = (last := samples[-1][0]) / 6
    after = [memory for minute, memory in samples if first <= minute <= first + width]
    end = [memory for minute, memory in samples if minute >= last - width]
    return statistics.median(after), statistics.median(end)


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="of each job")
    parser.add_argument("--first", type=float, default=2.0, help="minutes that are left out at the beginning")
    parser.add_argument("--every", type=float, default=2.0, help="seconds between samples")
    parser.add_argument("--jobs", nargs="+", default=["design", "fine_tuning"])
    options = parser.parse_args(arguments)
    minutes, first, every = (0.05, 0.0, 0.1) if options.tiny else (options.minutes, options.first, options.every)
    rows = []
    for job in [job for job in (design, fine_tuning) if job.__name__ in options.jobs]:
        samples = sampled(job, minutes, options.tiny, every)
        after, end = growth(samples, first)
        most = max(memory for _, memory in samples)
        share = f"{100 * (end / after - 1):+.1f}"
        rows.append((job.__name__, f"{samples[-1][0]:.1f}", f"{after:.0f}", f"{end:.0f}", f"{most:.0f}", share))
    columns = ("job", "minutes", f"after {first:g} min [MB]", "at the end [MB]", "peak [MB]", "growth [%]")
    timing.report("Resident memory of long jobs, 64 px", columns, rows, options.save)


if __name__ == "__main__":
    main()
