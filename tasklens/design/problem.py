"""The design problem, independent of start, method and networks, and the history of its solution."""

from dataclasses import dataclass
from typing import Any

from tasklens.design.variables import Free
from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.study.settings import CaptureSettings, Constraints

History = list[dict[str, Any]]  # a row per logged step of a design


@dataclass(frozen=True)
class Problem:
    """A design problem.

    Attributes:
        view: fields, wavelengths and pixels.
        limits: limits of the design.
        seed: seed of all random numbers.
        capture: capture settings, for supervised designs.
        dataset: sharp training images, for supervised designs.
        free: free variables by name, and their surfaces; None: all.
    """

    view: View
    limits: Constraints
    seed: int
    capture: CaptureSettings | None = None
    dataset: ImageDataset | None = None
    free: Free | None = None
