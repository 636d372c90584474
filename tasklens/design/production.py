"""Monte Carlo tolerancing by a classifier: perturbed lenses, refocused and measured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tasklens.optics.analysis import focus
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing import monte_carlo
from tasklens.optics.tolerancing.manufacturing_errors import draw
from tasklens.optics.tolerancing.monte_carlo import MonteCarlo
from tasklens.recognition.evaluation import CapturePipeline, classify
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress

RAYS = 1024  # rays per field and colour of a built lens
_ALLOWED_POINTS = 1.0  # largest loss of accuracy by which tolerances are allotted [points]

Images = tuple[Tensor, Tensor]  # images (N, 3, H, W) in [0, 1], and their labels (N,)


@dataclass(frozen=True)
class Production(MonteCarlo):
    """Production of one design, measured by a classifier; `view` has the fields of spots, too.

    Attributes:
        pipeline: returns the capture pipeline of a lens.
        classifier: function from captures (B, 3, H, W) to logits (B, C).
    """

    pipeline: Callable[[Lens], CapturePipeline]
    classifier: Callable[[Tensor], Tensor]

    def accuracy(self, lens: Lens, images: Images) -> tuple[Tensor, float]:
        """Return the accuracy (F,) of each field [%], and the mean cross-entropy."""
        sharp, labels = images
        correct, _, losses = classify(self.classifier, self.pipeline(lens).all_fields(sharp), labels)
        return 100 * correct.double().mean(-1), float(losses.mean())

    def measure(self, lens: Lens, images: Images) -> dict[str, Any]:
        """Measure a lens; `failed` is 1 if a field gets no light; the lens is measured anyway."""
        fields, loss = self.accuracy(lens, images)
        rays = trace_fields(lens, self.view, sobol_disc(RAYS, seed=0))
        mtf = torch.stack(geometric_mtf(rays, self.view.directions, [focus.frequency(self.view)]))
        return {
            "accuracy": float(fields.mean()),
            "worst_field_accuracy": float(fields.min()),
            "loss": loss,
            "rms_spot_um": 1e3 * float(rms_spot_radius(rays, centroid(rays)).mean()),
            "mtf_quarter_nyquist": float(mtf.mean()),
            "failed": int(not rays.valid.any(-1).any(-1).all()),
        }


def built_lenses(
    production: Production, count: int, seed: int, images: Images, checkpoint: Checkpoint = NO_CHECKPOINT
) -> list[dict[str, Any]]:
    """Measure the design and `count` built lenses.

    Returns:
        A row per lens: its name, the values of `Production.measure`, and the shift of its image plane [um].
    """
    part = checkpoint.part("built lenses")
    if part.result is not None:
        return part.result["rows"]
    rows = [] if part.state is None else part.state["rows"]
    progress = Progress("built lenses", count)
    if not rows:
        rows = [{"lens": "design"} | production.measure(production.lens, images) | {"focus_um": 0.0}]
    draws = draw(production.errors, count, seed)
    for k in range(len(rows) - 1, count):
        lens, shift = production.build(draws[k])
        rows.append({"lens": k} | production.measure(lens, images) | {"focus_um": 1e3 * float(shift)})
        progress(k + 1, accuracy=rows[-1]["accuracy"])
        part.save(k + 1, rows=rows)
    part.finish(rows=rows)
    return rows


def one_at_a_time(
    production: Production,
    indices: Sequence[int],
    nominal: float,
    images: Images,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> dict[int, float]:
    """Measure the change of accuracy due to single errors, averaged over both signs [points].

    Args:
        indices: indices of the errors.
        nominal: accuracy of the design on the same images [%].
    """
    part = checkpoint.part("errors one at a time")
    state = part.state if part.result is None else part.result
    changes: dict[int, float] = {} if state is None else state["changes"]
    progress = Progress("errors one at a time", len(indices))
    for step, k in enumerate(indices, 1):
        if k in changes:
            continue
        direction = torch.zeros(len(production.errors), dtype=torch.float64)
        direction[k] = 1.0
        accuracies = [production.accuracy(production.build(s * direction)[0], images)[0].mean() for s in (1, -1)]
        changes[k] = float(sum(accuracies)) / 2 - nominal
        progress(step)
        part.save(step, changes=changes)
    part.finish(changes=changes)
    return changes


def widest_tolerances(
    production: Production,
    displacements: Tensor,
    count: int,
    seed: int,
    images: Images,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Tensor | None:
    """Find the widest tolerances (P,) with which 95 % of lenses lose at most one point, as factors on the grade.

    Args:
        displacements: (P,) ray displacements by the errors [um].
        count: number of lenses that are built with each set of tolerances.
        images: images other than those of the reported accuracies.

    Returns:
        None if even the tightest tolerances do not suffice, or no light reaches some field.
    """
    if not displacements.isfinite().all():
        return None
    draws = draw(production.errors, count, seed + monte_carlo.SEED)
    threshold = production.accuracy(production.lens, images)[0].mean() - _ALLOWED_POINTS
    progress = Progress("allocation of tolerances", monte_carlo.TRIALS)
    part = checkpoint.part("allocation of tolerances")
    state = part.state if part.result is None else part.result
    # Outcomes of the trials so far: a resumed job repeats the trials in the same order.
    outcomes: list[bool] = [] if state is None else state["passed"]
    trial = iter(range(1, monte_carlo.TRIALS + 1))

    def is_good(lens: Lens) -> bool:
        return bool(production.accuracy(lens, images)[0].mean() >= threshold - 1e-9)

    def passes(tolerances: Tensor) -> bool:
        step = next(trial)
        if step > len(outcomes):
            outcomes.append(production.enough_are_good(draws, tolerances, is_good))
            progress(step)
            part.save(step, passed=outcomes)
        return outcomes[step - 1]

    widest = monte_carlo.widest(displacements, passes)
    part.finish(passed=outcomes)
    return widest
