"""Design of a lens from its settings: method, then repair, figures and margins."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from tasklens.design import end_to_end, imported, least_squares, spot, supervised
from tasklens.design.apertures import with_clear_apertures, with_open_apertures
from tasklens.design.constraints import first_order_margins, manufacturing_margins, worst_margin
from tasklens.design.criteria import (
    CaptureCriterion,
    Contrast,
    ImageError,
    JointTaskLoss,
    TaskLoss,
)
from tasklens.design.driver import History
from tasklens.design.problem import Problem
from tasklens.design.ray_space import repair
from tasklens.design.start import flat
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, chief_rays, clear_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import (
    EndToEndSettings,
    JointRaySpaceSettings,
    LeastSquaresSettings,
    RaySpaceSettings,
    SpotSettings,
    SupervisedSettings,
    TaskDrivenSettings,
)
from tasklens.study.lens_entries import ImportedLens, LensDesign

_POLISH_SEED = 10007  # added to the seed, so that the polish does not begin with the first images of the design
_APERTURE = 1.02  # clear aperture of an imported lens without one, over the radius that light uses

Starts = Mapping[str, tuple[Lens, float]]  # lenses and their minival accuracies [%], mean or worst field, by name
Notes = dict[str, Any]  # spec, origin, figures and margins in a lens file


def design(
    wanted: LensDesign,
    classifier: nn.Module | None,
    dataset: ImageDataset | None,
    starts: Starts,
    candidates: Mapping[str, Lens],
    checkpoint: Checkpoint = NO_CHECKPOINT,
    task: Task | None = None,
) -> tuple[Lens, Notes, History]:
    """Design a lens by its method, or import it from its file.

    Args:
        wanted: specification and method of the lens.
        classifier, dataset: trained classifier and training images, for supervised designs.
        starts: lenses of which the best one by its accuracy is the start, if any.
        candidates: lenses that compete for the finish of a supervised design.
        checkpoint: checkpoint of the job.
        task: task of the network `classifier`, where it is not classification.

    Returns:
        The lens with its clear apertures, the notes for its file, and a row per logged step.
    """
    settings, view = wanted.entry.design, view_of_spec(wanted.spec)
    if isinstance(settings, ImportedLens):
        lens, origin = imported.fit(settings, view, wanted.spec.f_number, wanted.rays)
        used = clear_semi_diameters(lens, view, torch.cat([OUTLINE, sobol_disc(wanted.rays, seed=0)]))
        origin = {"design": wanted.entry.design_name, "method": "file"} | origin
        return *with_notes(lens, _APERTURE * used, wanted, origin), []
    start, start_name = flat(wanted.entry.plastics, wanted.spec, wanted.constraints), "flat"
    if isinstance(settings, LeastSquaresSettings):
        start_name = "random paraxial lenses"
    if starts:
        start_name = max(starts, key=lambda name: starts[name][1])
        start = with_open_apertures(starts[start_name][0])
        candidates = {start_name: start}
    problem = Problem(view, wanted.constraints, wanted.seed, wanted.capture, dataset)
    if isinstance(settings, SupervisedSettings):
        lens, found, history = _supervised(start, candidates, problem, settings, classifier, task, checkpoint)
    else:
        found = {}
        lens, history = _descend(start, problem, settings, classifier, checkpoint)
    origin = {
        "design": wanted.entry.design_name,
        "method": settings.method,
        "seed": wanted.seed,
        "start": start_name,
        **found,
    }
    # Only divergence of what the lens came from concerns it: a diverged restart or finish may not have been selected.
    unrelated = ["restart"]
    if found.get("start") in candidates:
        unrelated.append("refinement")
    if not found.get("finished", True):
        unrelated.append("finish")
    wrong = [row for row in history if "cause" in row and not row["phase"].startswith(tuple(unrelated))]
    if wrong:
        origin["diverged"] = f"step {wrong[-1]['step']}: {wrong[-1]['cause']}"
    # Limits were weighed against the loss until here.
    return *with_notes(*repair(lens, view, wanted.constraints), wanted, origin), history


def _descend(
    start: Lens,
    problem: Problem,
    settings: EndToEndSettings | SpotSettings | LeastSquaresSettings,
    classifier: nn.Module | None,
    checkpoint: Checkpoint,
) -> tuple[Lens, History]:
    """Run the method of `settings` from `start`; return the lens and its history."""
    if isinstance(settings, SpotSettings):
        return spot.design(start, problem, settings, checkpoint)
    if isinstance(settings, LeastSquaresSettings):
        return least_squares.design(start, problem, settings, checkpoint)
    assert classifier is not None  # end-to-end designs have one
    return end_to_end.design(start, classifier, problem, settings, "end-to-end", checkpoint)


def _supervised(
    start: Lens,
    candidates: Mapping[str, Lens],
    problem: Problem,
    settings: SupervisedSettings,
    classifier: nn.Module | None,
    task: Task | None,
    checkpoint: Checkpoint,
) -> tuple[Lens, Notes, History]:
    """Design by a supervisor; return the lens, what its file says of its origin, and the history."""
    opened = {name: with_open_apertures(lens) for name, lens in candidates.items()}
    dataset = problem.dataset
    criteria: dict[str, Callable[[RaySpaceSettings], CaptureCriterion | Contrast]] = {
        "image_error": lambda part: ImageError(logarithm=False),
        "log_image_error": lambda part: ImageError(logarithm=True),
        "contrast": lambda part: Contrast(problem.view.directions),
    }
    if task is not None:
        from tasklens.recognition import task_networks  # torchvision's detectors, which other designs do without

        assert classifier is not None  # it is the task's network
        by_task = TaskLoss(task_networks.frozen(classifier), task)
        criteria["classification"] = lambda part: by_task
    elif isinstance(settings, TaskDrivenSettings):
        assert classifier is not None and dataset is not None  # they supervise
        supervisor = TaskLoss(frozen(classifier, dataset.images, settings.batch_norm))
        criteria["classification"] = lambda part: supervisor
    elif isinstance(settings, JointRaySpaceSettings):
        assert classifier is not None
        rate = settings.network_learning_rate
        criteria["classification"] = lambda part: JointTaskLoss(copy.deepcopy(classifier), rate, part.steps, part.final)
    lens, found, history = supervised.design(start, opened, criteria, problem, settings, checkpoint)
    if isinstance(settings, TaskDrivenSettings) and settings.polish is not None:
        assert classifier is not None
        fresh = replace(problem, seed=problem.seed + _POLISH_SEED)
        lens, rows = end_to_end.design(lens, classifier, fresh, settings.polish, "polish", checkpoint)
        history = history + rows
        found.pop("validation_loss", None)  # of the lens before
    return lens, found, history


def with_notes(lens: Lens, clear: Tensor, wanted: LensDesign, origin: Notes) -> tuple[Lens, Notes]:
    """Add clear apertures (S,) [mm] to surfaces without one; return the lens and the notes for its file."""
    view = view_of_spec(wanted.spec)
    margins = manufacturing_margins(lens, wanted.constraints, torch.minimum(clear, lens.semi_diameter))
    margins |= first_order_margins(lens, wanted.constraints, view, chief_rays(lens, view))
    name, value = worst_margin(margins)
    lens = with_clear_apertures(lens, clear)
    notes = {
        "spec": wanted.spec.model_dump(mode="json"),
        "origin": origin,
        "figures": figures(lens, view, wanted.rays),
        "margins": {key: float(margin.min()) for key, margin in margins.items() if margin.numel()},
        "worst_margin": {"limit": name, "value": value},
    }
    return lens, notes
