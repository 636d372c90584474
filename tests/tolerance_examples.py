"""A doublet, and grades that tolerate only some manufacturing errors."""

from examples import f64, make_lens, materials

from tasklens.materials.material import D_LINE
from tasklens.optics.analysis.focus import refocus
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.settings.tolerance_settings import GRADES, Grade

COC, OKP4, AIR = materials("COC", "OKP4", "air")
NOTHING = dict.fromkeys(GRADES["precision_moulding"], 0.0)


def grade(**tolerances: float) -> Grade:
    """A grade with only these tolerances."""
    return Grade(**NOTHING | tolerances)


def doublet() -> tuple[Lens, View]:
    """Two elements that form an image, and a view of its axis and of 5 degrees along x and y."""
    lens = make_lens(
        [0.0, 0.25, -0.2, -0.15, 0.1],
        [0.2, 0.6, 0.3, 0.5, 4.0],
        (AIR, COC, AIR, OKP4, AIR),
        semi_diameter=[0.5, 1.4, 1.4, 1.4, 1.4],
    )
    view = View(f64([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]]), 4.6, (0.6563, D_LINE, 0.4861), 2.0, 31)
    return refocus(lens, view, "spot"), view
