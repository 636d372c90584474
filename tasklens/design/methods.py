"""Design of a lens from its settings: method, repair, figures, margins and the test for a local optimum."""

import copy
from collections.abc import Mapping
from contextlib import nullcontext
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from tasklens.design import descents, least_squares
from tasklens.design.constraints import limit_margins, smallest_margins, worst_margin
from tasklens.design.criteria import JointTaskLoss, TaskLoss
from tasklens.design.image_quality import CRITERIA
from tasklens.design.objective import Criterion, Objective
from tasklens.design.optimum import local_optimum
from tasklens.design.problem import History, Problem
from tasklens.design.ray_space import repair
from tasklens.design.start import flat
from tasklens.design.variables import with_coefficients
from tasklens.optics.analysis.datasheet import figures, means
from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, clear_semi_diameters
from tasklens.optics.io import imported
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.recognition.classifiers import frozen
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.tasks import Classification, Task
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.devices import single_thread
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import ImportedLens, LensDesign

_APERTURE = 1.02  # clear semi-diameter / illuminated radius, of an imported lens without apertures
# Focus by a network
_FOCUS_IMAGES = slice(24)  # training images in fixed order, each at all fields of the validation
_MICRO_BATCH = 36
_PLANES, _STEP = 3, 2.0  # planes on each side of the peak, and the blur that defocus adds to the next [pixels]
_LAST_STEP = 0.25
_ROUNDS = 4  # searches after the first, while the best plane is the outermost

Notes = dict[str, Any]  # spec, origin, figures and margins in a lens file


def design(
    plan: LensDesign,
    classifier: nn.Module | None,
    dataset: ImageDataset | None,
    starts: Mapping[str, Lens],
    accuracies: Mapping[str, float],
    checkpoint: Checkpoint = NO_CHECKPOINT,
    task: Task | None = None,
) -> tuple[Lens, Notes, History, nn.Module | None]:
    """Design a lens by its method, or import it from its file.

    Args:
        plan: specification and method of the lens.
        classifier, dataset: trained classifier and training images, for supervised designs.
        starts: lenses of which the best is the start, by name.
        accuracies: their minival accuracies [%], of the mean or the worst field; empty if the criterion of the design
            compares them.
        checkpoint: checkpoint of the job.
        task: task of the network `classifier`, if it is not classification.

    Returns:
        The lens with its clear apertures, the notes for its file, a row per logged step, and the network if it was
        trained with the lens.
    """
    settings, view = plan.entry.design, view_of_spec(plan.spec)
    problem = Problem(view, plan.constraints, plan.seed, plan.capture, dataset, settings.free, plan.fields)
    if isinstance(settings, ImportedLens):
        return *_read_imported(settings, problem, plan, classifier), [], None
    origin = {"design": plan.entry.design_name, "method": settings.method, "seed": plan.seed}
    if isinstance(settings, LeastSquaresSettings):
        plates = flat(plan.entry.plastics, plan.spec, plan.constraints)
        lens, history = least_squares.design(plates, problem, settings, checkpoint)
        origin["start"] = "random paraxial lenses"
        return *with_notes(*repair(lens, view, plan.constraints), plan, origin), history, None

    @cache
    def frozen_loss(temperature: float) -> TaskLoss:
        assert classifier is not None and dataset is not None  # a supervised design has both
        if plan.network is not None and task is not None:
            from tasklens.recognition import task_networks  # imports torchvision's detectors: only these designs do

            return TaskLoss(task_networks.frozen(classifier), task)
        network = frozen(classifier, dataset.images, settings.batch_norm)
        return TaskLoss(network, task or Classification(temperature))

    def criterion(part: DescentSettings) -> Criterion:
        if part.criterion != "task":
            return CRITERIA[part.criterion]
        if part.network_learning_rate is None:
            return frozen_loss(part.temperature)
        joint, rate = copy.deepcopy(classifier), part.network_learning_rate
        assert joint is not None
        return JointTaskLoss(joint, rate, part.steps, part.final, task or Classification(part.temperature))

    start, origin["start"] = flat(plan.entry.plastics, plan.spec, plan.constraints), "flat"
    candidates = starts
    if accuracies:
        best = origin["start"] = max(accuracies, key=lambda name: accuracies[name])
        start = _prepared_start(starts[best], settings.keep_apertures)
        # With a frozen network, the start is the result if the descents do not improve it.
        candidates = {} if settings.descents[-1].trains_network else {best: starts[best]}
    prepared = {name: _prepared_start(lens, settings.keep_apertures) for name, lens in candidates.items()}
    with nullcontext() if plan.entry.reads_images else single_thread():  # without images all tensors are small
        lens, details, history, objective = descents.design(start, prepared, criterion, problem, settings, checkpoint)
        origin |= details
        repaired = repair(lens, view, plan.constraints, settings.free)
        keep_apertures = settings.keep_apertures and origin["start"] != "flat"  # plates have none
        final_lens, notes = with_notes(*repaired, plan, origin, keep_apertures)
        network = None
        if plan.entry.by_psfs:
            notes["local_optimum"] = local_optimum(final_lens, objective, settings.descents[-1])
            network = objective.criterion.network if isinstance(objective.criterion, JointTaskLoss) else None
    return final_lens, notes, history, network


def _read_imported(
    settings: ImportedLens, problem: Problem, plan: LensDesign, classifier: nn.Module | None
) -> tuple[Lens, Notes]:
    """Read an imported lens and set its focus; return it with the notes for its file."""
    lens, details = imported.fit(settings, problem.view, plan.spec.f_number)
    by, focused = details["focus"], lens
    if by == "network":
        assert classifier is not None and problem.dataset is not None  # inputs of the job unless the focus needs none
        network = frozen(classifier, problem.dataset.images, "stored")
        focused = _refocus_by_network(lens, TaskLoss(network, Classification(1.0)), problem)
    elif by != "file":
        focused = refocus(lens, problem.view, by)
    origin = {"design": plan.entry.design_name, "method": "file"} | details
    origin["image_plane_shift_mm"] = float(focused.thickness[-1] - lens.thickness[-1])
    pupil = torch.cat([OUTLINE, sobol_disc(plan.rays, seed=0)])
    radii = clear_semi_diameters(focused, problem.view.at_all_radii(), pupil)
    return with_notes(focused, _APERTURE * radii, plan, origin)


def _refocus_by_network(lens: Lens, loss: TaskLoss, problem: Problem) -> Lens:
    """Move the image plane of a lens to the least loss of a network on training images.

    The search begins at planes around the peak of the MTF, moves on while the best plane is the outermost, and then
    halves the distance between planes.
    """
    objective = Objective(loss, problem, None, False, _MICRO_BATCH, "chief_ray")
    start = refocus(lens, problem.view)
    pixel = float(paraxial(lens.detached(), problem.view.reference_um).f_number) * 1e-3 * problem.view.pixel_pitch_um
    losses: dict[float, float] = {}

    def best_plane(centre: float, planes: int, blur: float) -> float:
        """Return the shift of the least loss so far [mm], after planes around one."""
        for k in range(-planes, planes + 1):
            shift = round(centre + k * blur * pixel, 9)
            if shift not in losses:
                losses[shift] = float(objective.fixed_losses(move_image_plane(start, shift), 1.0, _FOCUS_IMAGES).mean())
        return min(losses, key=lambda shift: losses[shift])

    best = best_plane(0.0, _PLANES, _STEP)
    for _ in range(_ROUNDS):
        if min(losses) < best < max(losses):
            break
        best = best_plane(best, _PLANES, _STEP)
    step = _STEP
    while step > _LAST_STEP:
        step /= 2
        best = best_plane(best, 1, step)
    return move_image_plane(start, best)


def _prepared_start(lens: Lens, keep_apertures: bool) -> Lens:
    """Return a starting lens: with all coefficients of a design, and open apertures unless they are kept."""
    return with_coefficients(lens if keep_apertures else lens.with_open_apertures())


def with_notes(
    lens: Lens, radii: Tensor, plan: LensDesign, origin: Notes, keep_apertures: bool = False
) -> tuple[Lens, Notes]:
    """Return the lens, with missing clear apertures set unless `keep_apertures`, and the notes for its file.

    Args:
        radii: (S,) illuminated radii [mm]; they become the clear apertures.
    """
    view = view_of_spec(plan.spec)
    margins = limit_margins(lens, plan.constraints, view, torch.minimum(radii, lens.semi_diameter))
    name, value = worst_margin(margins)
    lens = lens if keep_apertures else lens.with_clear_apertures(radii)
    notes = {
        "spec": plan.spec.model_dump(mode="json"),
        "origin": origin,
        "figures": figures(lens, view, plan.rays),
        "means": means(lens, view.at(plan.averaged), plan.rays),
        "margins": smallest_margins(margins),
        "worst_margin": {"limit": name, "value": value},
    }
    return lens, notes
