"""From a design job to a finished lens: the method that the study names, then the lens' figures and margins."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tasklens.design import end_to_end as descent
from tasklens.design import imported as imported
from tasklens.design import least_squares, spot, task
from tasklens.design.constraints import first_order_margins, manufacturing_margins, worst_margin
from tasklens.design.ray_space import repair
from tasklens.design.start import flat
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, chief_points, clear_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import (
    EndToEndSettings,
    ImportedLens,
    LeastSquaresSettings,
    SpotSettings,
    TaskDrivenSettings,
)

_POLISH_SEED = 10007  # added to the seed, so that the polish does not see the design's first images again
_APERTURE = 1.02  # clear aperture of a lens from a file that gives none, over what light uses of it


def design(
    job: LensDesign,
    classifier: torch.nn.Module | None,
    dataset: ImageDataset | None,
    baselines: Mapping[str, tuple[Lens, Path]],
    history: list[dict],
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, dict]:
    """Design a lens by the method of its job, or take it from its file.

    Args:
        job: what to design and how.
        classifier, images: the well-trained classifier and the training images, for designs that a task supervises.
        baselines: imaging lenses by name with the metrics files that judge them, for a design that starts from the best.
        history: receives a row per logged step.
        checkpoint: of the job.

    Returns:
        The lens with its clear apertures, and the notes for its file: spec, origin, figures, margins.
    """
    settings, looks = job.lens.design, view_of_spec(job.spec)
    if isinstance(settings, ImportedLens):
        lens, fitted = imported.fit(settings, looks, job.spec.f_number, job.rays)
        used = clear_semi_diameters(lens, looks, torch.cat([OUTLINE, sobol_disc(job.rays, seed=0)]))
        return finished(lens, _APERTURE * used, job, {"design": job.lens.design_name, "method": "file"} | fitted)
    start = flat(job.lens.plastics, job.spec, job.constraints)
    origin: dict = {"design": job.lens.design_name, "method": settings.method, "seed": job.seed, "start": "flat"}
    match settings:
        case SpotSettings():
            lens = spot.design(start, looks, job.constraints, settings, job.seed, history, checkpoint)
        case LeastSquaresSettings():
            origin["start"] = "random paraxial lenses"
            lens = least_squares.design(start, looks, job.constraints, settings, job.seed, history, checkpoint)
        case TaskDrivenSettings():
            problem = descent.Problem(looks, job.constraints, job.capture, dataset, job.seed)
            lens = task.design(start, classifier, problem, settings, history, checkpoint)
            if settings.polish is not None:
                fresh = replace(problem, seed=problem.seed + _POLISH_SEED)
                lens = descent.descend(lens, classifier, fresh, settings.polish, history, "polish", checkpoint)
        case EndToEndSettings():
            if baselines:
                origin["start"] = best(baselines)
                start = open_apertures(baselines[origin["start"]][0])
            problem = descent.Problem(looks, job.constraints, job.capture, dataset, job.seed)
            lens = descent.descend(start, classifier, problem, settings, history, "end-to-end", checkpoint)
    last = history[-1] if history else {}
    if "cause" in last:
        origin["diverged"] = f"step {last['step']}: {last['cause']}"
    # Limits were soft until here: a little broken, they are mended.
    return finished(*repair(lens, looks, job.constraints), job, origin)


def best(baselines: Mapping[str, tuple[Lens, Path]]) -> str:
    """Name of the imaging lens with the highest minival accuracy after fine-tuning."""
    import pandas

    def accuracy(name: str) -> float:
        rows = pandas.read_csv(baselines[name][1])
        return rows.loc[rows["metric"] == "minival_accuracy", "value"].mean()

    return max(baselines, key=accuracy)


def open_apertures(lens: Lens) -> Lens:
    """The lens with no clear aperture but its stop, as designs take it."""
    semi_diameter = torch.full_like(lens.semi_diameter, torch.inf)
    semi_diameter[lens.stop] = lens.semi_diameter[lens.stop]
    return replace(lens, semi_diameter=semi_diameter)


def finished(lens: Lens, clear: Tensor, job: LensDesign, origin: dict) -> tuple[Lens, dict]:
    """The lens with clear apertures (S,) [mm], where it has none yet, and the notes for its file.

    A ray beyond them is lost: classifiers bend the rims of lenses, and a few rays of the pupil's outline go far astray.
    """
    looks = view_of_spec(job.spec)
    margins = manufacturing_margins(lens, job.constraints, torch.minimum(clear, lens.semi_diameter))
    margins |= first_order_margins(lens, job.constraints, looks, chief_points(lens, looks))
    name, value = worst_margin(margins)
    lens = replace(lens, semi_diameter=torch.where(lens.semi_diameter.isinf(), clear, lens.semi_diameter))
    notes = {
        "spec": job.spec.model_dump(mode="json"),
        "origin": origin,
        "figures": figures(lens, looks, job.rays),
        "margins": {key: float(margin.min()) for key, margin in margins.items() if margin.numel()},
        "worst_margin": {"limit": name, "value": value},
    }
    return lens, notes
