"""Design by descents: the first from the start, several times where that is asked for, each other from the best before.

Gradient descent from flat plates ends in poor lenses, for two reasons: equal steps of the variables cause very
different ray displacements, and results depend strongly on the image order. So each step is measured in ray
displacement (see `ray_space`), and of several restarts from the plates the best ones go on.

Where a design begins with other lenses, the best of them by its criterion is the start. Lenses are judged as their file
will have them, with limits repaired and apertures set, on other images than those that lead a descent; so is the
result: one that has only learned the images of its descent gives way to its start.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from tasklens.design.criteria import Criterion
from tasklens.design.descent import Descent, run
from tasklens.design.problem import History, Problem
from tasklens.design.ray_space import repair
from tasklens.design.supervision import Supervisor
from tasklens.optics.apertures import with_clear_apertures
from tasklens.optics.lens import Lens
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.study.design_settings import DescentSettings, GradientDesignSettings


@dataclass(frozen=True)
class _Descended:
    """A lens with its loss as `Descent.least`, its supervisor, and the labels of the descents that it has come from."""

    lens: Lens
    supervisor: Supervisor | None = None
    least: tuple[bool, float] = (False, 0.0)
    labels: tuple[str, ...] = ()


def design(
    start: Lens,
    candidates: Mapping[str, Lens],
    criterion: Callable[[DescentSettings], Criterion],
    problem: Problem,
    settings: GradientDesignSettings,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Lens, dict[str, Any], History, Supervisor]:
    """Design a lens by the descents of `settings`.

    Args:
        start: starting lens, without candidates.
        candidates: lenses by name, of which the best by the criterion of the last descent is the start.
        criterion: maker of the criterion of a descent.

    Returns:
        The lens: of the last descent, or the candidate that it began with, if that is better by a criterion that is
        not trained. What its file says of its origin: its loss, those of all candidates on the same images, the
        candidate that it began with as `start`, whether it is the `finished` one, and where it `diverged`. The history
        of all descents. And the supervisor of the last descent.
    """
    torch.manual_seed(problem.seed)  # TrivialAugment uses torch's global generator
    generator = torch.Generator().manual_seed(problem.seed)
    history: History = []

    def supervisor(part: DescentSettings) -> Supervisor:
        made = criterion(part)
        micro_batch = settings.micro_batch
        if made.trained or settings.batch_norm == "batch":  # batch norms take the statistics of the whole step
            micro_batch = (part.batch_size or settings.batch_size) * len(problem.view.fields)
        return Supervisor(made, problem, part.size, settings.augment, micro_batch, part.centre, settings.tolerances)

    def selection_loss(judge: Supervisor, lens: Lens) -> float:
        repaired = with_clear_apertures(*repair(lens, problem.view, problem.limits, problem.free))
        return judge.selection_loss(repaired, settings.descents[-1].pixels[1])

    origin: dict[str, Any] = {}
    losses: dict[str, float] = {}
    if candidates:
        judge = supervisor(settings.descents[-1])
        losses = {name: selection_loss(judge, lens) for name, lens in candidates.items()}
        chosen = min(losses, key=lambda name: losses[name])
        start, origin["start"] = candidates[chosen], chosen
        history += [{"phase": f"candidate {name}", "validation_loss": loss} for name, loss in losses.items()]
    lenses = [_Descended(start)] * settings.descents[0].lenses
    for k, part in enumerate(settings.descents, 1):
        descended = []
        for i, before in enumerate(lenses[: part.lenses], 1):
            label = f"descent {k}" if part.lenses == 1 else f"descent {k}, lens {i} of {part.lenses}"
            seed = int(torch.randint(2**31, (), generator=generator))
            descent = Descent(before.lens, supervisor(part), settings, part, seed)  # a trained network begins anew
            lens, rows = run(descent, label, checkpoint)
            history += rows
            descended.append(_Descended(lens, descent.supervisor, descent.least, (*before.labels, label)))
        lenses = sorted(descended, key=lambda each: each.least)
    best = lenses[0]
    assert best.supervisor is not None  # there is a descent
    lens, loss, labels, trained = best.lens, best.least[1], best.labels, best.supervisor.criterion.trained
    if losses and not trained:
        loss = selection_loss(best.supervisor, lens)
        history.append({"phase": "finished", "validation_loss": loss})
        origin["finished"] = loss <= losses[chosen]
        if not origin["finished"]:
            lens, loss, labels = start, losses[chosen], ()
    # Only divergence of what the lens came from concerns it.
    causes = [row for row in history if "cause" in row and row["phase"].removesuffix(", diverged") in labels]
    if causes:
        origin["diverged"] = f"step {causes[-1]['step']}: {causes[-1]['cause']}"
    if not trained:  # else it is of another network than any other
        origin["validation_loss"] = loss
    if losses:
        origin["candidate_losses"] = losses
    return lens, origin, history, best.supervisor
