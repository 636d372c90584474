"""Estimate of GPU hours of a study by table: arithmetic of its networks over a measured throughput.

Operations of a network forward, two per multiply-add, are counted on tensors without memory; with the backward pass to
its input it takes twice as many, to its weights three times. A study file says how often each happens. A table pays
only for jobs that the tables before it do not need. One GPU trains ResNet50 with --throughput images a second, and is
assumed to run all other networks at the same rate of operations. The estimate omits rays, captures, designs by image
quality alone, and the check of a restoration while it trains.
"""

from collections import defaultdict
from functools import cache
from itertools import product

import timing
import timm
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from restoration.nafnet import NAFNet
from tasklens.recognition.classifiers import Classifier
from tasklens.settings.design_settings import GradientDesignSettings
from tasklens.settings.names import SHARP
from tasklens.settings.network_settings import ClassifierSettings
from tasklens.study import loading
from tasklens.study.study import Study
from tasklens.study.table_contents import tables

RESNET50 = ClassifierSettings(model="resnet50", pretrained=True)
A100 = 2470.0  # images/s, mixed precision, one A100 80 GB: NVIDIA DeepLearningExamples, ResNet50 v1.5 for PyTorch
FORWARD, TO_INPUT, TO_WEIGHTS = 1, 2, 3  # operations of a pass, in those of a forward pass


def operations(network: nn.Module, size: int) -> float:
    """Operations of a forward pass of an image of `size` pixels through a network on the meta device."""
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(torch.zeros(1, 3, size, size, device="meta"))
    return float(counter.get_total_flops())


class Cost:
    """Operations of the jobs of a study, with `train` and `test` images if the study takes a whole folder."""

    def __init__(self, study: Study, train: int, test: int):
        self.study, self.fields = study, len(study.spec.fields_mm)
        self.train, self.test = study.images.train or train - study.images.minival, study.images.test or test
        self.forward = cache(self.forward)

    def forward(self, classifier: str | None, size: int) -> float:
        """Operations of a classifier of the study, or of the restoration network if the name is None."""
        with torch.device("meta"):
            if classifier is None:
                return operations(NAFNet(self.study.restoration), size)
            return operations(build_classifier(self.study.classifier(classifier)), size)

    def design(self, lens: str) -> float:
        """Operations of designing a lens with a classifier; 0 for design by image quality alone."""
        settings, size = self.study.lens(lens).design, self.study.images.size
        if not isinstance(settings, GradientDesignSettings):
            return 0.0
        total = 0.0
        for descent in settings.by_network:
            images = descent.steps * descent.lenses * (descent.batch_size or settings.batch_size)
            back = TO_WEIGHTS if descent.trains_network else TO_INPUT
            total += self.fields * images * back * self.forward(self.study.supervisor, descent.size or size)
        return total

    def fine_tune(self, lens: str, classifier: str, restored: bool) -> float:
        """Operations of fine-tuning and measuring a classifier on the captures of a lens, restored or not."""
        size, training = self.study.images.size, self.study.fine_tuning
        evaluated = (self.test + self.study.images.minival) * (1 if lens == SHARP else self.fields)
        trained = training.epochs * self.train
        total = (FORWARD * evaluated + TO_WEIGHTS * trained) * self.forward(classifier, size)
        if restored:
            total += FORWARD * (evaluated + trained) * self.forward(None, size)
        return total

    def restore(self) -> float:
        """Operations of training a restoration for all its steps."""
        settings = self.study.restoration
        return settings.steps * settings.batch_size * TO_WEIGHTS * self.forward(None, self.study.images.size)


def build_classifier(settings: ClassifierSettings) -> Classifier:
    """Build a network from its settings, without weights."""
    return Classifier(timm.create_model(settings.model, **settings.arguments)).eval()


def charged(study: Study, cost: Cost) -> dict[tuple, tuple[str, float]]:
    """Return, by job with a network, the first table that needs it, and its operations."""
    charges: dict[tuple, tuple[str, float]] = {}
    for table in tables(study):
        name = table.name
        for lens in table.lenses:
            charges.setdefault(("design", lens), (name, cost.design(lens)))
        for lens, classifier in product((SHARP, *table.lenses), table.classifiers):
            restored = name == "table4" and lens != SHARP
            job = "fine-tuning", lens, classifier, restored
            charges.setdefault(job, (name, cost.fine_tune(lens, classifier, restored)))
            if restored:
                charges.setdefault(("restoration", lens), (name, cost.restore()))
    return {job: entry for job, entry in charges.items() if entry[1]}


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("study", nargs="?", default="config/imagenet.yaml", help="a study file")
    parser.add_argument("--train", type=int, default=1_281_167, help="images in the folders, ImageNet's by default")
    parser.add_argument("--test", type=int, default=50_000)
    parser.add_argument("--throughput", type=float, default=A100, help="images/s of training ResNet50 at 224 pixels")
    options = parser.parse_args(arguments)
    study = loading.load(options.study)
    cost = Cost(study, options.train, options.test)
    with torch.device("meta"):
        rate = TO_WEIGHTS * options.throughput * operations(build_classifier(RESNET50), 224)
    hours = defaultdict(list)
    for (kind, *_), (table, count) in charged(study, cost).items():
        hours[table, kind] += len(study.seeds) * [count / rate / 3600]
    rows = [(*key, len(values), f"{sum(values):.3g}") for key, values in sorted(hours.items())]
    rows.append(("all", "", sum(map(len, hours.values())), f"{sum(map(sum, hours.values())):.3g}"))
    title = f"Study {study.name}, at {options.throughput:g} images a second ({rate / 1e12:.3g} TFLOP/s)"
    timing.report(title, ("table", "jobs", "count", "GPU-hours"), rows, options.save)


if __name__ == "__main__":
    main()
