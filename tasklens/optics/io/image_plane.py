"""Place of the image plane of a lens from a file: there, or refocused, and the words for it."""

import math

from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError

_BY = {"mtf": "the peak of the MTF", "spot": "the smallest mean RMS spot"}


def place_image_plane(lens: Lens, view: View, own_distance: float, focus: str | float | None) -> tuple[Lens, list[str]]:
    """Place the image plane of a lens, and say so if it moves.

    Args:
        own_distance: distance of the object in the file [mm].
        focus: "file", as in the file; "mtf" or "spot", where these are best; or the shift [um] away from the lens.
            None: as in the file, but at the peak of the MTF if the object of the view is at another distance.

    Raises:
        InputError: another `focus`, or a lens that cannot be focused.
    """
    moved = view.object_vergence != 1 / own_distance
    criterion, by_shift = "mtf" if moved else "file", 0.0
    try:
        if isinstance(focus, str):
            criterion = focus
        elif focus is not None:
            by_shift = float(focus)
        if criterion not in ("file", *_BY) or not math.isfinite(by_shift):
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"focus {focus} (--focus): expected micrometres, such as -10, or file, mtf or spot") from None
    if criterion == "file":
        return move_image_plane(lens, 1e-3 * by_shift) if by_shift else lens, []
    if focus is not None:
        check_focal_length(lens, view.reference_um, f"--focus {focus} needs")
    focused = refocus(lens, view, "spot" if criterion == "spot" else "mtf")
    remark = f"image plane {1e3 * float(focused.thickness[-1] - lens.thickness[-1]):+.1f} um, to {_BY[criterion]}"
    if moved:
        own = "infinity" if math.isinf(own_distance) else f"{own_distance:g} mm"
        requested = f"{1 / view.object_vergence:g} mm" if view.object_vergence else "infinity"
        remark = f"object at {own} in the file: refocused for {requested}: {remark}"
    return move_image_plane(focused, 1e-3 * by_shift), [remark]
