"""The focus of a lens by what a network recognises through it."""

from tasklens.design.criteria import TaskLoss
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens

_IMAGES = slice(24)  # training images in fixed order, each at all fields of the validation
_MICRO_BATCH = 36
_PLANES, _STEP = 3, 2.0  # planes on each side of the peak, and the blur that defocus adds to the next [pixels]
_LAST_STEP = 0.25
_ROUNDS = 4  # searches after the first, while the best plane is the outermost


def refocus_by_network(lens: Lens, loss: TaskLoss, problem: Problem) -> Lens:
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
                losses[shift] = float(objective.fixed_losses(move_image_plane(start, shift), 1.0, _IMAGES).mean())
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
