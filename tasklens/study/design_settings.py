"""Settings of the design methods, and the entries of a study's lenses; no torch here."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, FilePath, field_validator, model_validator

from tasklens.materials.material import Material
from tasklens.study.settings import (
    CaptureSettings,
    ClassifierSettings,
    Constraints,
    Count,
    Fraction,
    Frozen,
    Name,
    Positive,
    Spec,
    renamed,
)

Magnification = Annotated[float, Field(ge=1)]
Part = Annotated[float, Field(gt=0, le=1)]


PRESETS = {  # the paper's (section 3.3); ours, for 500 steps from flat plates
    "paper": {"curvature": 1e-4, "thickness": 1e-4, "alpha_4": 1e-4, "decay": 0.02, "normalised": False},
    "ours": {"curvature": 4e-3, "thickness": 2e-3, "alpha_4": 4e-3, "decay": 0.5, "final": 0.05},
}


class LearningRates(Frozen):
    """Learning rates of AdamW for the lens; a study may also name one of `PRESETS`."""

    curvature: Positive = Field(1e-4, description="Of curvatures [1/mm].")
    thickness: Positive = Field(1e-4, description="Of thicknesses [mm].")
    alpha_4: Positive = Field(1e-4, description="Of alpha_4, in the units that `normalised` says.")
    decay: Fraction = Field(0.02, description="Rate of each asphere order over that of the one before (paper 3.3).")
    normalised: bool = Field(
        True,
        description="Rates are of alpha_k R^(k - 1), R the radius that light uses on the surface of the start [mm]; "
        "else of alpha_k itself, as in the paper.",
    )
    final: Fraction = Field(1.0, description="Rates at the last step, as a fraction; reached on a cosine.")

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, given: Any) -> Any:
        if not isinstance(given, str):
            return given
        if given not in PRESETS:
            raise ValueError(f"expected learning rates, or one of {', '.join(PRESETS)}")
        return PRESETS[given]


class ColdStart(Frozen):
    """Pixels that begin coarse and a stop that begins small; both reach their true size after a part of the steps."""

    pixel_scale: Magnification = Field(20.0, description="First pixel pitch, in pixels of the sensor.")
    pixel_duration: Part = Field(0.8, description="Part of the steps after which pixels are true.")
    stop_scale: Part = Field(0.3, description="First radius of the stop, in true radii.")
    stop_duration: Part = Field(0.5, description="Part of the steps after which the stop is open.")


_RENAMED_DESCENT = {"images": "batch_size", "rates": "learning_rates", "network_rate": "network_learning_rate"}


class JointDescentSettings(Frozen):
    """Lens and classifier descend the classifier's loss together, through captures, PSFs and rays."""

    _renamed = renamed(_RENAMED_DESCENT)

    steps: Count = Field(description="Steps of AdamW.")
    batch_size: Count = Field(64, description="Images per step, each at all nine fields.")
    size: Count | None = Field(None, description="Side to which images are reduced for the design [pixels]; or null.")
    rays: Count = Field(256, description="Rays per field and colour, drawn anew at each step.")
    learning_rates: LearningRates = Field(LearningRates(), description="Of the lens.")
    network_learning_rate: Positive = Field(1e-5, description="Of the classifier.")
    cold_start: ColdStart | None = Field(None, description="Coarse pixels and a small stop at first; null: neither.")
    penalty: Positive = Field(100.0, description="Weight of the squared violations of limits [1/mm^2].")
    augment: bool = Field(True, description="TrivialAugment on the sharp images.")


class RaySpaceSettings(Frozen):
    """Steps of a ray-space descent, each of a given ray displacement on the sensor; see design.ray_space."""

    _renamed = renamed({"stride": "step_size"})

    steps: Count = Field(description="Steps.")
    pixels: tuple[Magnification, Magnification] = Field(description="First and last pixel pitch [sensor pixels].")
    duration: Part = Field(1.0, description="Part of the steps in which the pixels reach their last size.")
    step_size: Positive = Field(0.5, description="RMS displacement of the rays by a step [present pixels].")
    final: Part = Field(0.1, description="Part of the step size at the last step, on a cosine.")
    momentum: float = Field(0.9, ge=0, lt=1, description="Of the gradient's running mean.")
    damping: Positive = Field(0.1, description="Of the Gauss-Newton metric, times its diagonal.")


class TaskDrivenSettings(Frozen):
    """Task-driven design from flat plates: the classifier is frozen, and trained only in the final polish, if any."""

    _renamed = renamed({"images": "batch_size", "starts": "restarts", "start": "restart", "refine": "refinement"})

    method: Literal["task"]
    batch_size: Count = Field(64, description="Images per step, each at all nine fields.")
    size: Count | None = Field(None, description="Side to which images are reduced for the design [pixels]; or null.")
    rays: Count = Field(256, description="Rays per field and colour, drawn anew at each step.")
    restarts: Count = Field(1, description="Descents from the plates, in images of another order; the best is refined.")
    restart: RaySpaceSettings = Field(description="Steps of each restart.")
    refinement: RaySpaceSettings = Field(description="Steps that refine the best restart.")
    augment: bool = Field(True, description="TrivialAugment on the sharp images.")
    micro_batch: Count = Field(
        64, description="Captures that the classifier sees at once: by stored statistics a matter of memory only."
    )
    batch_norm: Literal["stored", "batch"] = Field(
        "stored", description="By whose statistics the frozen classifier normalises."
    )
    polish: JointDescentSettings | None = Field(
        None, description="Lens and classifier together at the end (paper 3.3); null: none."
    )


class EndToEndSettings(JointDescentSettings):
    """A joint descent from flat plates, or from the best imaging lens by minival accuracy."""

    method: Literal["end_to_end"]
    start: Literal["flat", "best_imaging"] = Field(description="Where it starts.")


class SpotSettings(Frozen):
    """RMS spot size by AdamW from flat plates, with an opening stop."""

    _renamed = renamed({"rates": "learning_rates"})

    method: Literal["spot"]
    steps: Count = Field(description="Steps of AdamW.")
    rays: Count = Field(256, description="Rays per field and colour, drawn anew at each step.")
    learning_rates: LearningRates = Field(LearningRates(), description="Of the lens.")
    stop_scale: Part = Field(0.3, description="First radius of the stop, in true radii.")
    stop_duration: Part = Field(0.5, description="Part of the steps after which the stop is open.")
    penalty: Positive = Field(100.0, description="Weight of the squared violations of limits [1/mm].")


class LeastSquaresSettings(Frozen):
    """Damped least squares on ray residuals, from many random paraxial starts, as a lens designer works."""

    method: Literal["least_squares"]
    starts: Count = Field(150, description="Random paraxial starts.")
    evaluations: Count = Field(8000, description="Budget: evaluations of all residuals, with or without derivatives.")
    reference: Literal["centroid", "chief_ray"] = Field("centroid", description="Point that spots are about.")
    highest_order: Literal[4, 6, 8, 10] = Field(10, description="Highest asphere coefficient that varies.")
    corner_weight: Positive = Field(1.0, description="Weight of the corner; geometric from 1 on the axis.")
    max_chief_ray_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="Largest angle of a chief ray on the sensor [degrees]; null: none."
    )


class ImportedLens(Frozen):
    """A lens from a file, made to fit the specification; its materials are the file's."""

    elements: Name = Field(description="What the tables call its elements.")
    file: FilePath = Field(description="A Zemax file (.zmx), or a lens.yaml.")
    catalogues: tuple[FilePath, ...] = Field((), description="Glass catalogues that the file needs (.agf, or YAML).")

    @field_validator("file")
    @classmethod
    def _known_kind(cls, file: Path) -> Path:
        if file.suffix.lower() not in (".zmx", ".yaml", ".yml"):
            raise ValueError("expected a lens file, .zmx or .yaml")
        return file


DesignSettings = Annotated[
    TaskDrivenSettings | EndToEndSettings | SpotSettings | LeastSquaresSettings, Field(discriminator="method")
]


class LensEntry(Frozen):
    """One lens of the study: its elements, and how it is designed or where it is imported from."""

    name: str = Field(description="`{elements}-{design_name}`.")
    elements: str = Field(description="Name of its elements.")
    plastics: tuple[Material, ...] = Field(description="With their coefficients: editing one redesigns its lenses.")
    design_name: str = Field(description="Name of its design.")
    design: DesignSettings | ImportedLens = Field(description="How it comes about.")
    capture: CaptureSettings | None = Field(None, description="Where an ablation changes it; null: the study's.")

    @property
    def constrained(self) -> bool:
        """Whether its method is required to keep the constraints and the focal length; verification checks that.

        End-to-end design from flat is not, since it need not converge; nor is an imported lens.
        """
        failing = isinstance(self.design, EndToEndSettings) and self.design.start == "flat"
        return not (failing or isinstance(self.design, ImportedLens))


class LensDesign(Frozen):
    """Everything that the design of one lens may read of a study.

    Attributes:
        entry: the lens, its plastics and its method.
        spec, constraints: what it has to do and to keep.
        capture, classifier: for designs that a classifier supervises.
        rays: per field and colour, of the figures.
        seed: of everything random.
    """

    entry: LensEntry
    spec: Spec
    constraints: Constraints
    capture: CaptureSettings | None
    classifier: ClassifierSettings | None
    rays: int
    seed: int
