"""Monte Carlo of manufacture: lenses built from a design with random errors, and whether enough of them are good."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from tasklens.optics.analysis import focus
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing.allocation import YIELD
from tasklens.optics.tolerancing.manufacturing_errors import Error, draw, with_errors
from tasklens.optics.view import View


@dataclass(frozen=True)
class MonteCarlo:
    """Lenses built from a design, each focused to the design's distance from its MTF peak; differentiable in it.

    Attributes:
        lens: the design.
        view: fields, wavelengths and pixels of the focus.
        errors: P errors of a built lens.
    """

    lens: Lens
    view: View
    errors: Sequence[Error]

    @cached_property
    def peak(self) -> Tensor:
        """Distance of the peak of the design's MTF from its image plane [mm]."""
        return focus.peak(self.lens, self.view)

    def build(self, fractions: Tensor) -> tuple[Lens, Tensor]:
        """Build a lens with errors (P,) [fractions of tolerances]; return it focused, and its focus shift [mm]."""
        built_lens = with_errors(self.lens, self.errors, fractions, self.view.reference_um)
        return focus.focus_built(built_lens, self.view, self.peak)

    def draws(self, count: int, seed: int) -> Tensor:
        """Draw the errors (count, P) of lenses [fractions of tolerances]."""
        return draw(self.errors, count, seed)

    def enough_are_good(self, draws: Tensor, tolerances: Tensor, is_good: Callable[[Lens], bool]) -> bool:
        """Return whether a fraction `YIELD` of lenses is good.

        Args:
            draws: (count, P) errors of the lenses [fractions of tolerances].
            tolerances: (P,) tolerances as multiples of the grade's.
            is_good: the test of a built lens.
        """
        bad = 0
        for fractions in draws:
            bad += not is_good(self.build(tolerances * fractions)[0])
            if bad > (1 - YIELD) * len(draws):
                return False
        return True
