"""Settings of the design methods; no torch here."""

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from tasklens.study.learning_rates import LearningRates
from tasklens.study.quantities import (
    Angle,
    Batch,
    Count,
    LearningRate,
    Magnification,
    Name,
    Part,
    Positive,
    Rays,
    Small,
    Steps,
)
from tasklens.study.renamed import renamed
from tasklens.study.settings import Frozen
from tasklens.study.tolerance_settings import Grade


class ColdStart(Frozen):
    """Schedule with coarse pixels and a small stop at first; both reach full size after a fraction of the steps."""

    pixel_scale: Magnification = Field(20.0, description="Pixel pitch at the first step [sensor pixels].")
    pixel_duration: Part = Field(0.8, description="Fraction of the steps after which the pixel pitch is the sensor's.")
    stop_scale: Part = Field(0.3, description="Radius of the stop at the first step, as a fraction.")
    stop_duration: Part = Field(0.5, description="Fraction of the steps after which the stop is fully open.")


_RENAMED_DESCENT = {"images": "batch_size", "rates": "learning_rates", "network_rate": "network_learning_rate"}


class JointDescentSettings(Frozen):
    """Settings of joint gradient descent of lens and classifier on the classifier's loss."""

    _renamed = renamed(_RENAMED_DESCENT)

    steps: Steps = Field(description="Number of AdamW steps.")
    batch_size: Batch = Field(64, description="Images per step, each at all nine fields.")
    size: Count | None = Field(None, description="Side of the resized images [pixels]; null: not resized.")
    rays: Rays = Field(256, description="Rays per field and colour, sampled anew at each step.")
    learning_rates: LearningRates = Field(LearningRates(), description="Learning rates of the lens.")
    network_learning_rate: LearningRate | None = Field(
        1e-5, description="Learning rate of the classifier; null: frozen, the paper's plain task-driven protocol."
    )
    cold_start: ColdStart | None = Field(None, description="Coarse pixels and a small stop at first; null: none.")
    penalty: Positive = Field(100.0, description="Weight of the squared violations of limits [1/mm^2].")
    augment: bool = Field(True, description="TrivialAugment on the sharp images.")


class RaySpaceSettings(Frozen):
    """Settings of a ray-space descent: steps of given ray displacement on the sensor (see design.ray_space)."""

    _renamed = renamed({"stride": "step_size"})

    steps: Steps = Field(description="Number of steps.")
    pixels: tuple[Magnification, Magnification] = Field(description="First and last pixel pitch [sensor pixels].")
    duration: Part = Field(1.0, description="Fraction of the steps after which pixels have their last size.")
    step_size: Annotated[float, Field(gt=0, le=100)] = Field(
        0.5, description="RMS ray displacement per step [current pixels]."
    )
    final: Part = Field(0.1, description="Step size at the last step, as a fraction; cosine schedule.")
    momentum: float = Field(0.9, ge=0, lt=1, description="Momentum of the gradient's running mean.")
    damping: Positive = Field(0.1, description="Damping of the Gauss-Newton metric, times its diagonal.")
    criterion: Literal["classification", "image_error", "log_image_error", "contrast"] = Field(
        "classification",
        description="Loss of a capture: cross-entropy of the classifier, or the loss of the network of `task`; mean "
        "squared error from the sharp image (paper, Eq. 2), or its logarithm; or of a PSF: the contrast, real part of "
        "the OTF, lost at 1/4 and 1/2 of the Nyquist frequency of the present pixels.",
    )
    size: Count | None = Field(None, description="Side of the resized images [pixels]; null: not resized.")
    centre: Literal["pinhole", "chief_ray"] = Field(
        "pinhole",
        description="Centre of PSFs: the pinhole point, so that lost light finds the focal length, or the chief ray, "
        "as in all evaluation, so that distortion costs nothing within its limit.",
    )

    @field_validator("pixels")
    @classmethod
    def _ever_finer(cls, pixels: tuple[float, float]) -> tuple[float, float]:
        if pixels[0] < pixels[1]:
            raise ValueError("expected a first pitch that is as coarse as the last, or coarser")
        return pixels


class SupervisedSettings(Frozen):
    """Settings of supervised design by ray-space descent: from flat plates, or from imaging lenses, or from both.

    The refined best of some restarts from flat plates competes with the lenses of `candidates`; the best by validation
    loss is finished.
    """

    _renamed = renamed(
        {
            "images": "batch_size",
            "starts": "restarts",
            "start": "restart",
            "refine": "refinement",
            "size": "a key of each descent; move it to restart and refinement",
        }
    )

    batch_size: Batch = Field(64, description="Images per step, each at all nine fields.")
    rays: Rays = Field(256, description="Rays per field and colour, sampled anew at each step.")
    restarts: Small = Field(1, description="Descents from flat plates in different image orders; the best is refined.")
    restart: RaySpaceSettings | None = Field(None, description="Descent of each restart; null: none from flat plates.")
    refinement: RaySpaceSettings | None = Field(None, description="Descent that refines the best restart.")
    candidates: tuple[Name, ...] = Field(
        (),
        description="Designs whose lenses of the same elements and seed compete for the finish: imaging designs by its "
        "criterion; for `joint_ray_space` also task-driven ones, by minival accuracy of the worst field, fine-tuned.",
    )
    finish: RaySpaceSettings | None = Field(None, description="Last descent; null: none.")
    augment: bool = Field(True, description="TrivialAugment on the sharp images.")
    micro_batch: Batch = Field(
        64, description="Captures per forward pass; with stored batch-norm statistics it affects only memory."
    )
    tolerances: Grade | None = Field(
        None,
        description="Grade of manufacture for which the lens is designed: each step sees a lens built from it, with "
        "errors of its own, and focused; null: the lens as designed.",
    )

    @model_validator(mode="after")
    def _descents_have_starts(self) -> "SupervisedSettings":
        if (self.restart is None) != (self.refinement is None) or not (self.restart or self.candidates):
            raise ValueError("expected `restart` and `refinement`, or `candidates`, or all: what designs start from")
        if self.candidates and self.finish is None:
            raise ValueError("candidates: expected a `finish`, which starts from the best of them")
        return self

    @property
    def descents(self) -> dict[str, RaySpaceSettings]:
        """All descents by key."""
        found = {"restart": self.restart, "refinement": self.refinement, "finish": self.finish}
        return {name: descent for name, descent in found.items() if descent is not None}


class TaskDrivenSettings(SupervisedSettings):
    """Settings of task-driven design; the classifier is frozen, except in the optional polish."""

    method: Literal["task"]
    batch_norm: Literal["stored", "batch"] = Field(
        "stored", description="Statistics of the frozen classifier's batch norms: stored, or of the batch."
    )
    polish: JointDescentSettings | None = Field(
        None, description="Final joint descent of lens and classifier (paper 3.3); null: none."
    )
    task: Name | None = Field(
        None,
        description="One of `tasks.networks`, of which the network supervises in the classifier's place, frozen, on "
        "images with objects; null: the classifier.",
    )

    @model_validator(mode="after")
    def _by_the_task(self) -> "TaskDrivenSettings":
        _ends_with_classification(self)
        if self.batch_norm == "batch":
            _holds_a_step(self)
        if self.polish is not None and self.tolerances is not None:
            raise ValueError("tolerances: expected no `polish`, which sees the lens as designed")
        if self.task is not None and (
            self.augment or self.polish or any(descent.size is not None for descent in self.descents.values())
        ):
            raise ValueError(
                "task: expected no `polish`, no `size` and `augment: false`, since masks fit the images as they are"
            )
        if self.task is not None and self.batch_norm == "batch":
            raise ValueError("task: expected `batch_norm: stored`, by which its network is frozen")
        return self


def _ends_with_classification(design: SupervisedSettings) -> None:
    *_, (name, last) = design.descents.items()
    if last.criterion != "classification":
        raise ValueError(f"{name}.criterion: expected classification in the last descent of a task-driven design")


def _holds_a_step(design: SupervisedSettings) -> None:
    captures = 9 * design.batch_size  # in the order of the nine fields: a part of them would be of some fields alone
    if design.micro_batch < captures:
        raise ValueError(
            f"micro_batch: expected the {captures} captures of a step or more, since batch norms take the statistics "
            f"of a micro-batch; got {design.micro_batch}"
        )


class JointRaySpaceSettings(SupervisedSettings):
    """Settings of design by ray-space descent in which a copy of the classifier is trained too, anew in each descent.

    Its start is the one of `candidates`, task-driven designs among them, whose worst field has the best minival
    accuracy after fine-tuning: what the loss of a network says that is trained for no lens is no measure of them.
    """

    method: Literal["joint_ray_space"]
    network_learning_rate: LearningRate = Field(description="Learning rate of the classifier.")

    @model_validator(mode="after")
    def _by_the_task_from_one_kind_of_start(self) -> "JointRaySpaceSettings":
        _ends_with_classification(self)
        _holds_a_step(self)
        if self.candidates and self.restart is not None:
            raise ValueError("candidates: expected these, or `restart` and `refinement`; not both")
        return self


class ImageQualitySettings(SupervisedSettings):
    """Settings of design by the error of the image (paper, 3.1) or the contrast of the PSF: no classifier."""

    method: Literal["image_quality"]

    @model_validator(mode="after")
    def _no_classifier(self) -> "ImageQualitySettings":
        for name, descent in self.descents.items():
            if descent.criterion == "classification":
                raise ValueError(f"{name}.criterion: expected image_error, log_image_error or contrast")
        return self


class EndToEndSettings(JointDescentSettings):
    """Settings of joint descent from flat plates, or from the best imaging lens by minival accuracy."""

    method: Literal["end_to_end"]
    start: Literal["flat", "best_imaging"] = Field(description="Starting lens.")

    @property
    def jointly_from(self) -> str | None:
        """Starting lens if the classifier is trained together with the lens."""
        return None if self.network_learning_rate is None else self.start


class SpotSettings(Frozen):
    """Settings of RMS spot minimisation by AdamW from flat plates, with an opening stop."""

    _renamed = renamed({"rates": "learning_rates"})

    method: Literal["spot"]
    steps: Steps = Field(description="Number of AdamW steps.")
    rays: Rays = Field(256, description="Rays per field and colour, sampled anew at each step.")
    learning_rates: LearningRates = Field(LearningRates(), description="Learning rates of the lens.")
    stop_scale: Part = Field(0.3, description="Radius of the stop at the first step, as a fraction.")
    stop_duration: Part = Field(0.5, description="Fraction of the steps after which the stop is fully open.")
    penalty: Positive = Field(100.0, description="Weight of the squared violations of limits [1/mm].")


class LeastSquaresSettings(Frozen):
    """Settings of damped least squares on ray residuals, from many random paraxial starts."""

    method: Literal["least_squares"]
    starts: Annotated[Count, Field(le=10**6)] = Field(150, description="Number of random paraxial starts.")
    evaluations: Steps = Field(8000, description="Budget of evaluations of all residuals, with or without derivatives.")
    reference: Literal["centroid", "chief_ray"] = Field("centroid", description="Reference point of spots.")
    highest_order: Literal[4, 6, 8, 10] = Field(10, description="Highest order of the variable asphere coefficients.")
    corner_weight: Positive = Field(1.0, description="Weight of the corner field; geometric from 1 on axis.")
    max_chief_ray_angle_deg: Angle | None = Field(
        None, description="Largest chief ray angle on the sensor [degrees]; null: no limit."
    )
    linear_beyond_um: Positive | None = Field(
        None,
        description="Error beyond which the cost of a ray grows linearly in a last stage [um]: a sharper core with "
        "more haze than the least RMS spot has; null: no such stage.",
    )
    vignetting: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None,
        description="Largest fraction of the light of a field that the clear aperture of one surface may stop, nothing "
        "on the axis, so that what passes makes a smaller spot; null: no light is stopped.",
    )


DesignSettings = Annotated[
    TaskDrivenSettings
    | ImageQualitySettings
    | EndToEndSettings
    | JointRaySpaceSettings
    | SpotSettings
    | LeastSquaresSettings,
    Field(discriminator="method"),
]
