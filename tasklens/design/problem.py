"""The design problem, independent of start, method and networks, and the history of its solution."""

from dataclasses import dataclass
from typing import Any

from tasklens.design.variables import Free
from tasklens.fields import SELECTION, Points
from tasklens.optics.view import View, drawn_points
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.specification import Constraints

History = list[dict[str, Any]]  # a row per logged step of a design


@dataclass(frozen=True)
class Problem:
    """A design problem.

    Attributes:
        view: sensor, wavelengths and pixels; the fields of losses are those of `fields`.
        limits: limits of the design.
        seed: seed of all random numbers.
        capture: capture settings, for supervised designs.
        dataset: sharp training images, for supervised designs.
        free: free variables by name, and their surfaces; None: all.
        fields: fields of the losses, fractions of the sensor; None: drawn anew in each step.
    """

    view: View
    limits: Constraints
    seed: int
    capture: CaptureSettings | None = None
    dataset: ImageDataset | None = None
    free: Free | None = None
    fields: Points | None = None

    def view_of_step(self, seed: int) -> View:
        """Return the view of a step: the fixed fields, or nine that are drawn uniformly in area."""
        return self.view.at(drawn_points(1, seed) if self.fields is None else self.fields)

    @property
    def views_of_validation(self) -> list[View]:
        """Views at the fields on which lenses of the design are compared; images take these sets in turns."""
        return [self.view.at(fields) for fields in ([self.fields] if self.fields else SELECTION)]
