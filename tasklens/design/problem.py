"""What a design is about, apart from its start, its method and its networks."""

from dataclasses import dataclass

from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.study.settings import CaptureSettings, Constraints


@dataclass(frozen=True)
class Problem:
    """What every method designs for.

    Attributes:
        view: fields, colours and pixels.
        limits: that every design keeps.
        seed: of everything random.
        capture: how images become captures; for a design that a classifier supervises.
        dataset: sharp training images; likewise.
    """

    view: View
    limits: Constraints
    seed: int
    capture: CaptureSettings | None = None
    dataset: ImageDataset | None = None
