"""Peak memory of one task-driven step at the paper's size, in a process of its own for each size of micro-batch.

64 images of 224 pixels at nine fields are 576 captures; the supervisor is ResNet50 with random weights, frozen. The
step is the design's own. It takes about 3 minutes of a core per micro-batch.
"""

import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor

import timing
import timm
import torch

from tasklens.design.criteria import TaskLoss
from tasklens.design.descent import Descent
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import Classifier, frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings
from tasklens.settings.specification import Constraints, Spec

LIMIT_GIB = 12  # a step that needs more memory fails without disturbing the machine


def measure(captures: int, tiny: bool) -> dict[str, float]:
    """Memory before and in one step with micro-batches of `captures` [GiB], and its processor time [s]."""
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_GIB << 30, LIMIT_GIB << 30))
    spec, limits, count, size = Spec(), Constraints(), 2 if tiny else 64, 64 if tiny else 224
    classifier = Classifier(timm.create_model("test_resnet" if tiny else "resnet50"))
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, 3, size, size), dtype=torch.uint8, generator=generator)
    dataset = ImageDataset(images, torch.arange(count), tuple(map(str, range(1000))))
    problem = Problem(view_of_spec(spec), limits, 0, CaptureSettings(), dataset)
    steps = DescentSettings(steps=2, pixels=(2, 1))  # no validation before the second step
    settings = GradientDesignSettings(descents=[steps], batch_size=count, rays=256)
    objective = Objective(TaskLoss(frozen(classifier, images)), problem, None, settings.augment, captures)
    before, begin = timing.peak_memory_gib(), time.process_time()
    plates = flat((builtin("COC"), builtin("OKP4")), spec, limits)
    Descent(plates, objective, settings, steps, seed=0).step(1)
    return {"before": before, "peak": timing.peak_memory_gib(), "seconds": time.process_time() - begin}


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--captures", type=int, nargs="+", default=[16, 64], help="sizes of micro-batch")
    options = parser.parse_args(arguments)
    rows = []
    for captures in options.captures:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            result = process.submit(measure, captures, options.tiny).result()
        rows.append((captures, f"{result['before']:.2f}", f"{result['peak']:.2f}", f"{result['seconds']:.0f}"))
    columns = ("captures at once", "before the step [GiB]", "peak [GiB]", "processor time [s]")
    timing.report("Memory of one step: 64 images x 9 fields, ResNet50, 224 px", columns, rows, options.save)


if __name__ == "__main__":
    main()
