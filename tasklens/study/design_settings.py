"""What the ways to design a lens are told: frozen typed classes with units, limits and defaults; no torch here."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, FilePath, field_validator, model_validator

from tasklens.materials.material import Material
from tasklens.study.settings import Capture, Count, Fraction, Frozen, Name, Positive

Magnification = Annotated[float, Field(ge=1)]


PRESETS = {  # the paper's (section 3.3); ours, for 500 steps from flat plates
    "paper": {"curvature": 1e-4, "thickness": 1e-4, "alpha_4": 1e-4, "decay": 0.02, "normalised": False},
    "ours": {"curvature": 4e-3, "thickness": 2e-3, "alpha_4": 4e-3, "decay": 0.5, "final": 0.05},
}


class Rates(Frozen):
    """AdamW step sizes of the lens; each asphere order above alpha_4 takes `decay` times the one before (paper 3.3).

    `normalised`: the step sizes of alpha_k are those of alpha_k R^(k - 1), R the radius that light uses on the surface
    of the starting lens in mm; else of alpha_k itself, as in the paper. A study may also name one of `PRESETS`.
    """

    curvature: Positive = 1e-4
    thickness: Positive = 1e-4
    alpha_4: Positive = 1e-4
    decay: Fraction = 0.02
    normalised: bool = True
    final: Fraction = 1.0  # the rates at the last step, as a fraction; reached on a cosine

    @model_validator(mode="before")
    @classmethod
    def _named(cls, given: Any) -> Any:
        if not isinstance(given, str):
            return given
        if given not in PRESETS:
            raise ValueError(f"expected rates, or one of {', '.join(PRESETS)}")
        return PRESETS[given]


class ColdStart(Frozen):
    """Pixels that begin coarse and a stop that begins small; both reach their true size after a part of the steps."""

    pixel_scale: Magnification = 20.0
    pixel_duration: Annotated[float, Field(gt=0, le=1)] = 0.8
    stop_scale: Annotated[float, Field(gt=0, le=1)] = 0.3
    stop_duration: Annotated[float, Field(gt=0, le=1)] = 0.5


class Descent(Frozen):
    """Lens and classifier descend the classifier's loss together, through captures, PSFs and rays."""

    steps: Count
    images: Count = 64
    size: Count | None = None  # pixels to which the side of the pictures is reduced for the design; null: none
    rays: Count = 256
    rates: Rates = Rates()
    network_rate: Positive = 1e-5
    cold_start: ColdStart | None = None
    penalty: Positive = 100.0
    augment: bool = True


class Walk(Frozen):
    """Steps of a task-driven design, each of a given ray displacement; see design.task."""

    steps: Count
    pixels: tuple[Magnification, Magnification]  # first and last, in pixels of the sensor
    duration: Annotated[float, Field(gt=0, le=1)] = 1.0  # part of the steps in which the pixels reach their last size
    stride: Positive = 0.5  # RMS displacement of the rays by a step, in present pixels
    final: Annotated[float, Field(gt=0, le=1)] = 0.1  # part of the stride at the last step, on a cosine
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9
    damping: Positive = 0.1


class Task(Frozen):
    """Task-driven design from flat plates: the classifier is frozen, and trained only in the final polish, if any."""

    method: Literal["task"]
    images: Count = 64  # per step, each at all nine fields
    size: Count | None = None  # pixels to which the side of the pictures is reduced for the design; null: none
    rays: Count = 256
    starts: Count = 1  # walks from the plates, in pictures of another order; the best goes on
    start: Walk
    refine: Walk
    augment: bool = True
    micro_batch: Count = 64  # captures that a frozen classifier sees at once; by stored statistics memory only
    batch_norm: Literal["stored", "batch"] = "stored"  # by whose statistics the frozen classifier normalises
    polish: Descent | None = None  # lens and classifier together at the end (paper 3.3)


class EndToEnd(Descent):
    """A descent from flat plates, or from the best imaging lens by minival accuracy."""

    method: Literal["end_to_end"]
    start: Literal["flat", "best_imaging"]


class Spot(Frozen):
    """RMS spot size by AdamW from flat plates, with an opening stop."""

    method: Literal["spot"]
    steps: Count
    rays: Count = 256
    rates: Rates = Rates()
    stop_scale: Annotated[float, Field(gt=0, le=1)] = 0.3
    stop_duration: Annotated[float, Field(gt=0, le=1)] = 0.5
    penalty: Positive = 100.0


class LeastSquares(Frozen):
    """Damped least squares on ray residuals, from many random paraxial starts, as a lens designer works."""

    method: Literal["least_squares"]
    starts: Count = 150
    evaluations: Count = 8000  # of all residuals, with or without their derivatives
    reference: Literal["centroid", "chief_ray"] = "centroid"
    highest_order: Literal[4, 6, 8, 10] = 10
    corner_weight: Positive = 1.0
    max_chief_ray_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = None


class Outside(Frozen):
    """A lens from a file (.zmx, or a lens.yaml), made to fit the specification; its glasses from `catalogues` too.

    `elements` is what the tables call it; its plastics are the file's.
    """

    elements: Name
    file: FilePath
    catalogues: tuple[FilePath, ...] = ()

    @field_validator("file")
    @classmethod
    def _known_kind(cls, file: Path) -> Path:
        if file.suffix.lower() not in (".zmx", ".yaml", ".yml"):
            raise ValueError("expected a lens file, .zmx or .yaml")
        return file


Design = Annotated[Task | EndToEnd | Spot | LeastSquares, Field(discriminator="method")]


class Lens(Frozen):
    """One lens of the study: how many elements of which plastic, and how it comes about."""

    name: str
    elements: str
    plastics: tuple[Material, ...]  # with their coefficients: editing one redesigns the lenses that use it
    design_name: str
    design: Design | Outside
    capture: Capture | None = None  # where an ablation changes it; else that of the study

    @property
    def keeps_constraints(self) -> bool:
        """Whether its method promises to keep the constraints and the focal length: verification holds it to them.

        End-to-end design from flat does not: it need not converge.
        """
        failing = isinstance(self.design, EndToEnd) and self.design.start == "flat"
        return not (failing or isinstance(self.design, Outside))
