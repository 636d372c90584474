"""Design by descents: the first from the start, with optional restarts; each later one from the best lens so far.

Gradient descent from flat plates ends in poor lenses, for two reasons: equal steps of the variables cause very
different ray displacements, and results depend strongly on the image order. So each step is measured in ray
displacement (see `ray_space`), and the best of several restarts from the plates are refined.

Restarts are judged by the criterion of the descent that continues them, so that each criterion chooses its own.

If a design begins with other lenses, the best of them by its criterion is the start. Lenses are compared as saved:
limits repaired, apertures set, and, if there are enough, on images other than those that guide a descent. A result
that has only overfitted the images of its descent is replaced by its start.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from tasklens.design.descent import Descent, run
from tasklens.design.objective import Criterion, Objective
from tasklens.design.problem import History, Problem
from tasklens.design.ray_space import as_saved
from tasklens.optics.lens import Lens
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings

_JUDGED = ("criterion", "temperature", "corner_weight")  # settings by which two descents judge lenses alike


@dataclass(frozen=True)
class _Result:
    """A lens with its `Descent.least`, its objective, and the labels of the descents that led to it."""

    lens: Lens
    objective: Objective | None = None
    least: tuple[bool, float] = (False, 0.0)
    labels: tuple[str, ...] = ()


def _rank(
    results: Sequence[_Result],
    part: DescentSettings,
    following: DescentSettings,
    objective: Callable[[DescentSettings], Objective],
) -> list[_Result]:
    """Sort the results of a descent, the best first: by its own validation, or by the criterion that follows it."""
    same = all(getattr(part, key) == getattr(following, key) for key in _JUDGED)
    if same or len(results) == 1:
        return sorted(results, key=lambda result: result.least)
    judge = objective(following)
    losses = [judge.validation_loss(result.lens, following.pixels[0]) for result in results]
    order = sorted(range(len(results)), key=lambda i: (results[i].least[0], losses[i]))
    return [results[i] for i in order]


def design(
    start: Lens,
    candidates: Mapping[str, Lens],
    criterion: Callable[[DescentSettings], Criterion],
    problem: Problem,
    settings: GradientDesignSettings,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, dict[str, Any], History, Objective]:
    """Design a lens by the descents of `settings`.

    Args:
        start: starting lens, without candidates.
        candidates: lenses by name; the best one by the criterion of the last descent is the start.
        criterion: function that returns the criterion of a descent.

    Returns:
        The lens, its origin, the history of all descents, and the objective of the last descent. The lens is the
        result of the last descent, or its starting candidate if that is better by a criterion that is not trained. The
        origin holds the loss of the lens, the losses of all candidates on the same images, the starting candidate as
        `start`, whether the lens is the result (`finished`), and the step at which it `diverged`.
    """
    torch.manual_seed(problem.seed)  # TrivialAugment uses torch's global generator
    generator = torch.Generator().manual_seed(problem.seed)
    history: History = []

    def objective(part: DescentSettings) -> Objective:
        measure = criterion(part)
        micro_batch = settings.micro_batch
        if measure.trained or settings.batch_norm == "batch":  # batch norms use the statistics of the whole step
            fields = len(problem.view_of_step(0).fields)
            micro_batch = (part.batch_size or settings.batch_size) * fields
        options = part.size, settings.augment, micro_batch, part.centre, settings.grade, part.corner_weight
        return Objective(measure, problem, *options)

    def selection_loss(selector: Objective, lens: Lens) -> float:
        saved = as_saved(lens, problem.view, problem.limits, problem.free)
        return selector.selection_loss(saved, settings.descents[-1].pixels[1])

    origin: dict[str, Any] = {}
    losses: dict[str, float] = {}
    if candidates:
        selector = objective(settings.descents[-1])
        losses = {name: selection_loss(selector, lens) for name, lens in candidates.items()}
        best_candidate = min(losses, key=lambda name: losses[name])
        start, origin["start"] = candidates[best_candidate], best_candidate
        history += [{"phase": f"candidate {name}", "validation_loss": loss} for name, loss in losses.items()]
    lenses = [_Result(start)] * settings.descents[0].lenses
    for k, part in enumerate(settings.descents, 1):
        results = []
        for i, parent in enumerate(lenses[: part.lenses], 1):
            label = f"descent {k}" if part.lenses == 1 else f"descent {k}, lens {i} of {part.lenses}"
            seed = int(torch.randint(2**31, (), generator=generator))
            descent = Descent(parent.lens, objective(part), settings, part, seed)  # a trained network starts afresh
            lens, rows = run(descent, label, checkpoint)
            history += rows
            results.append(_Result(lens, descent.objective, descent.least, (*parent.labels, label)))
        following = settings.descents[k] if k < len(settings.descents) else part
        lenses = _rank(results, part, following, objective)
    best = lenses[0]
    assert best.objective is not None  # there is a descent
    lens, loss, labels, trained = best.lens, best.least[1], best.labels, best.objective.criterion.trained
    if losses and not trained:
        loss = selection_loss(best.objective, lens)
        history.append({"phase": "finished", "validation_loss": loss})
        origin["finished"] = loss <= losses[best_candidate]
        if not origin["finished"]:
            lens, loss, labels = start, losses[best_candidate], ()
    # Only the divergence of descents that led to the lens is reported.
    causes = [row for row in history if "cause" in row and row["phase"].removesuffix(", diverged") in labels]
    if causes:
        origin["diverged"] = f"step {causes[-1]['step']}: {causes[-1]['cause']}"
    if not trained:  # losses of different networks do not compare
        origin["validation_loss"] = loss
    if losses:
        origin["candidate_losses"] = losses
    return lens, origin, history, best.objective
