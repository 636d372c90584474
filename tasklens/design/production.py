"""Production of a design in simulation: lenses with errors of manufacture, focused, and measured by a classifier."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tasklens.imaging import PsfCamera
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, evaluation_psf, rms_spot_radius, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing import allocation, focus
from tasklens.optics.tolerancing.errors import Error, built, draw
from tasklens.optics.view import View
from tasklens.recognition.evaluation import CapturePipeline, classify
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress

_RAYS = 1024  # per field and colour of a built lens
_ALLOWED_POINTS = 1.0  # loss of accuracy that tolerances are allotted for

Images = tuple[Tensor, Tensor]  # (N, 3, H, W) in [0, 1], and labels (N,)


@dataclass(frozen=True)
class Production:
    """Production of one design.

    Attributes:
        lens: the design.
        view: fields, wavelengths and pixels.
        errors: P errors of a built lens.
        camera: returns the camera of PSFs (F, 3, K, K).
        classifier: function from captures (B, 3, H, W) to logits (B, C).
    """

    lens: Lens
    view: View
    errors: Sequence[Error]
    camera: Callable[[Tensor], PsfCamera]
    classifier: Callable[[Tensor], Tensor]

    def build(self, fractions: Tensor, peak: Tensor) -> tuple[Lens, Tensor]:
        """Return a lens with errors (P,) over their tolerances, focused as `focus.focused`, and its shift [mm]."""
        return focus.focused(built(self.lens, self.errors, fractions, self.view.reference), self.view, peak)

    def accuracy(self, lens: Lens, images: Images) -> tuple[Tensor, float]:
        """Return the accuracy (F,) of each field [%], and the mean cross-entropy."""
        pipeline = CapturePipeline(self.camera(evaluation_psf(lens, self.view, _RAYS)))
        correct, losses = classify(self.classifier, pipeline, *images)
        return 100 * correct.double().mean(-1), float(losses.mean())

    def measure(self, lens: Lens, images: Images) -> dict[str, Any]:
        """Measure a lens; one that lets no light through to some field has `failed`, and is measured all the same."""
        fields, loss = self.accuracy(lens, images)
        rays = trace_fields(lens, self.view, sobol_disc(_RAYS, seed=0))
        return {
            "accuracy": float(fields.mean()),
            "worst_field_accuracy": float(fields.min()),
            "loss": loss,
            "rms_um": 1e3 * float(rms_spot_radius(rays, centroid(rays)).mean()),
            "mtf": float(torch.stack(geometric_mtf(rays, self.view.directions, [focus.frequency(self.view)])).mean()),
            "failed": int(not rays.valid.any(-1).any(-1).all()),
        }


def built_lenses(
    production: Production, count: int, seed: int, images: Images, checkpoint: Checkpoint = NO_CHECKPOINT
) -> list[dict[str, Any]]:
    """Measure the design and `count` built lenses.

    Returns:
        A row for each: its name, what `Production.measure` returns, and the shift of its image plane.
    """
    part = checkpoint.part("built lenses")
    if part.result is not None:
        return part.result["rows"]
    rows = [] if part.state is None else part.state["rows"]
    progress = Progress("built lenses", count)
    peak = focus.peak(production.lens, production.view)
    if not rows:
        rows = [{"lens": "design"} | production.measure(production.lens, images) | {"focus_um": 0.0}]
    drawn = draw(production.errors, count, seed)
    for k in range(len(rows) - 1, count):
        lens, shift = production.build(drawn[k], peak)
        rows.append({"lens": k} | production.measure(lens, images) | {"focus_um": 1e3 * float(shift)})
        progress(k + 1, accuracy=rows[-1]["accuracy"])
        part.save(k + 1, rows=rows)
    part.finish(rows=rows)
    return rows


def one_at_a_time(
    production: Production,
    chosen: Sequence[int],
    nominal: float,
    images: Images,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> dict[int, float]:
    """Measure the change of the accuracy by single errors of both signs, their mean [points].

    Args:
        chosen: indices of the errors.
        nominal: accuracy of the design on the same images [%].
    """
    part = checkpoint.part("errors one at a time")
    known = part.state if part.result is None else part.result
    found: dict[int, float] = {} if known is None else known["found"]
    peak = focus.peak(production.lens, production.view)
    progress = Progress("errors one at a time", len(chosen))
    for step, k in enumerate(chosen, 1):
        if k in found:
            continue
        along = torch.zeros(len(production.errors), dtype=torch.float64)
        along[k] = 1.0
        accuracies = [production.accuracy(production.build(s * along, peak)[0], images)[0].mean() for s in (1, -1)]
        found[k] = float(sum(accuracies)) / 2 - nominal
        progress(step)
        part.save(step, found=found)
    part.finish(found=found)
    return found


def allotted(
    production: Production,
    displacements: Tensor,
    count: int,
    seed: int,
    images: Images,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> Tensor | None:
    """Find the widest tolerances (P,), over those of the grade, with which 95 % of lenses lose at most one point.

    Args:
        displacements: (P,) of rays by each error [um].
        count: number of lenses that are built with each set of tolerances.
        images: not those by which lenses are reported.

    Returns:
        None if even the tightest tolerances that are tried do not suffice, or no light comes to some field.
    """
    if not displacements.isfinite().all():
        return None
    peak = focus.peak(production.lens, production.view)
    drawn = draw(production.errors, count, seed + allocation.SEED)
    least = production.accuracy(production.lens, images)[0].mean() - _ALLOWED_POINTS
    progress = Progress("allocation of tolerances", allocation.TRIALS)
    part = checkpoint.part("allocation of tolerances")
    known = part.state if part.result is None else part.result
    passed: list[bool] = [] if known is None else known["passed"]  # of the trials in their order, which repeats itself
    trial = iter(range(1, allocation.TRIALS + 1))

    def passes(tolerances: Tensor) -> bool:
        step, bad = next(trial), 0
        if step <= len(passed):
            return passed[step - 1]
        for fractions in drawn:
            lens, _ = production.build(tolerances * fractions, peak)
            bad += bool(production.accuracy(lens, images)[0].mean() < least - 1e-9)
            if bad > (1 - allocation.YIELD) * count:
                break
        progress(step, bad=bad)
        passed.append(bad <= (1 - allocation.YIELD) * count)
        part.save(step, passed=passed)
        return passed[-1]

    found = allocation.widest(displacements, passes)
    part.finish(passed=passed)
    return found
