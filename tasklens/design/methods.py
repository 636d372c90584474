"""From a design job to a finished lens: the method that the study names, then the lens' figures and margins."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tasklens.design import end_to_end as descent
from tasklens.design import imported as outside
from tasklens.design import least_squares, spot, task
from tasklens.design.constraints import first_order_margins, manufacturing_margins, worst_margin
from tasklens.design.ray_space import within_limits
from tasklens.design.start import flat
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, chief_points, clear_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.pipeline.jobs import DesignJob
from tasklens.recognition.dataset import Pictures
from tasklens.runtime.checkpoints import NOTHING_KEPT, Checkpoint
from tasklens.study.design_settings import EndToEnd, LeastSquares, Outside, Spot, Task

_POLISH_SEED = 10007  # added to the seed, so that the polish does not see the design's first pictures again
_APERTURE = 1.02  # clear aperture of a lens from a file that gives none, over what light uses of it


def design(
    job: DesignJob,
    recogniser: torch.nn.Module | None,
    pictures: Pictures | None,
    rivals: Mapping[str, tuple[Lens, Path]],
    history: list[dict],
    checkpoint: Checkpoint = NOTHING_KEPT,
) -> tuple[Lens, dict]:
    """Design a lens by the method of its job, or take it from its file.

    Args:
        job: what to design and how.
        recogniser, pictures: the well-trained classifier and the training pictures, for designs that a task supervises.
        rivals: imaging lenses by name with the metrics files that judge them, for a design that starts from the best.
        history: receives a row per logged step.
        checkpoint: of the job.

    Returns:
        The lens with its clear apertures, and the notes for its file: spec, origin, figures, margins.
    """
    settings, looks = job.lens.design, view_of_spec(job.spec)
    if isinstance(settings, Outside):
        lens, fitted = outside.fit(settings, looks, job.spec.f_number, job.rays)
        used = clear_semi_diameters(lens, looks, torch.cat([OUTLINE, sobol_disc(job.rays, seed=0)]))
        return finished(lens, _APERTURE * used, job, {"design": job.lens.design_name, "method": "file"} | fitted)
    start = flat(job.lens.plastics, job.spec, job.constraints)
    origin: dict = {"design": job.lens.design_name, "method": settings.method, "seed": job.seed, "start": "flat"}
    match settings:
        case Spot():
            lens = spot.design(start, looks, job.constraints, settings, job.seed, history, checkpoint)
        case LeastSquares():
            origin["start"] = "random paraxial lenses"
            lens = least_squares.design(start, looks, job.constraints, settings, job.seed, history, checkpoint)
        case Task():
            problem = descent.Problem(looks, job.constraints, job.capture, pictures, job.seed)
            lens = task.design(start, recogniser, problem, settings, history, checkpoint)
            if settings.polish is not None:
                fresh = replace(problem, seed=problem.seed + _POLISH_SEED)
                lens = descent.descend(lens, recogniser, fresh, settings.polish, history, "polish", checkpoint)
        case EndToEnd():
            if rivals:
                origin["start"] = best(rivals)
                start = open_apertures(rivals[origin["start"]][0])
            problem = descent.Problem(looks, job.constraints, job.capture, pictures, job.seed)
            lens = descent.descend(start, recogniser, problem, settings, history, "end-to-end", checkpoint)
    last = history[-1] if history else {}
    if "cause" in last:
        origin["diverged"] = f"step {last['step']}: {last['cause']}"
    # Limits were soft until here: a little broken, they are mended.
    return finished(*within_limits(lens, looks, job.constraints), job, origin)


def best(rivals: Mapping[str, tuple[Lens, Path]]) -> str:
    """Name of the imaging lens with the highest minival accuracy after fine-tuning."""
    import pandas

    def accuracy(name: str) -> float:
        rows = pandas.read_csv(rivals[name][1])
        return rows.loc[rows["metric"] == "minival_accuracy", "value"].mean()

    return max(rivals, key=accuracy)


def open_apertures(lens: Lens) -> Lens:
    """The lens with no clear aperture but its stop, as designs take it."""
    semi_diameter = torch.full_like(lens.semi_diameter, torch.inf)
    semi_diameter[lens.stop] = lens.semi_diameter[lens.stop]
    return replace(lens, semi_diameter=semi_diameter)


def finished(lens: Lens, clear: Tensor, job: DesignJob, origin: dict) -> tuple[Lens, dict]:
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
