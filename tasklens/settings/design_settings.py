"""Settings of designs: a start and a list of descents, or least squares; no torch here."""

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator, model_validator

from tasklens.settings.base import (
    Angle,
    Batch,
    Count,
    Fraction,
    Frozen,
    LearningRate,
    Magnification,
    Name,
    Part,
    Positive,
    Rays,
    Small,
    Steps,
)
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.tolerance_settings import Grade

VariableName = Literal["curvature", "thickness", "alpha_4", "alpha_6", "alpha_8", "alpha_10"]
CriterionName = Literal["task", "spot", "image_error", "log_image_error", "correlation", "wiener_error", "contrast"]
SurfaceNumber = Annotated[int, Field(ge=0, le=1000)]

STARTS = ("flat", "best_imaging", "best_spot")  # starts with a keyword

OPTIMIZER_KEYS = {  # keys of a descent that only one optimizer reads
    "ray_space": ("step_size", "momentum", "damping"),
    "adamw": ("learning_rates", "betas", "penalty", "max_incidence_deg"),
}

_UNREAD = {"spot": ("centre", "size", "batch_size"), "contrast": ("size", "batch_size")}  # of criteria without images
PRESETS = {  # those of the paper (section 3.3), and ours for 500 steps from flat plates
    "paper": {"curvature": 1e-4, "thickness": 1e-4, "alpha_4": 1e-4, "decay": 0.02, "normalised": False},
    "ours": {"curvature": 4e-3, "thickness": 2e-3, "alpha_4": 4e-3, "decay": 0.5},
}


class LearningRates(Frozen):
    """Learning rates of AdamW for the lens; a study may also name one of `PRESETS`."""

    curvature: LearningRate = Field(1e-4, description="Learning rate of curvatures [1/mm].")
    thickness: LearningRate = Field(1e-4, description="Learning rate of thicknesses [mm].")
    alpha_4: LearningRate = Field(1e-4, description="Learning rate of alpha_4, in the units of `normalised`.")
    decay: Fraction = Field(0.02, description="Ratio of learning rates of successive asphere orders (paper 3.3).")
    normalised: bool = Field(
        True,
        description="Optimise alpha_k R^(k - 1), with R the illuminated radius on the surface of the start [mm]; "
        "false: alpha_k itself, as in the paper.",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in PRESETS:
            raise ValueError(f"expected learning rates, or one of {', '.join(PRESETS)}")
        return PRESETS[value]


class DescentSettings(Frozen):
    """Settings of one descent: optimizer, criterion, pixels and steps."""

    steps: Steps = Field(description="Number of steps.")
    lenses: Small = Field(
        1,
        description="Number of lenses to descend from: the best ones of the previous descent. The first descent "
        "begins this many times from the start, with different image orders.",
    )
    optimizer: Literal["ray_space", "adamw"] = Field(
        "ray_space",
        description="ray_space: steps of a given ray displacement on the sensor, with a Gauss-Newton metric of the "
        "rays; adamw: AdamW on the parameters, as in the paper.",
    )
    criterion: CriterionName = Field(
        "task",
        description="Loss per field. task: the network's loss in its task, for a classifier the cross-entropy; spot: "
        "the RMS spot radius [mm]; image_error, log_image_error, correlation, wiener_error: of captures, the mean "
        "squared error from the sharp image (paper, Eq. 2), its logarithm, 1 - their normalised correlation, or the "
        "error after the best linear filter; contrast: of PSFs, the contrast (real part of the OTF) lost at 1/4 and "
        "1/2 of the Nyquist frequency of the current pixels.",
    )
    temperature: Magnification = Field(
        1.0, description="T of the loss T cross_entropy(logits / T): above 1, confident wrong answers weigh less."
    )
    network_learning_rate: LearningRate | None = Field(
        None, description="Learning rate of a copy of the network, trained with the lens; null: the network is frozen."
    )
    batch_size: Batch | None = Field(
        None, description="Images per step, each at all fields of the step; null: `batch_size` of the design."
    )
    size: Count | None = Field(None, description="Side of the resized images [pixels]; null: not resized.")
    corner_weight: Positive = Field(
        1.0, description="Weight of the corner field in the mean loss; geometric series from 1 on axis."
    )
    pixels: tuple[Magnification, Magnification] = Field(
        (1.0, 1.0), description="First and last pixel pitch [sensor pixels]."
    )
    duration: Part = Field(1.0, description="Fraction of the steps after which pixels have their last size.")
    stop_scale: Part = Field(1.0, description="Radius of the stop at the first step, as a fraction of the full radius.")
    stop_duration: Part = Field(0.5, description="Fraction of the steps after which the stop is fully open.")
    centre: Literal["pinhole", "chief_ray"] = Field(
        "pinhole",
        description="Centre of PSFs. pinhole: the pinhole point, so that lost light drives the focal length to its "
        "value; chief_ray: the chief ray, as in all evaluation, so that distortion within its limit costs nothing.",
    )
    final: Part = Field(
        0.1,
        description="Learning rates at the end, as a fraction (cosine schedule); also the step size of ray space, from "
        "`duration` on.",
    )
    step_size: Annotated[float, Field(gt=0, le=100)] = Field(
        0.5, description="Ray space: RMS ray displacement per step [current pixels]."
    )
    momentum: float = Field(0.9, ge=0, lt=1, description="Ray space: momentum of the gradient's running mean.")
    damping: Positive = Field(0.1, description="Ray space: damping of the metric, times its diagonal.")
    learning_rates: LearningRates = Field(LearningRates(), description="AdamW: learning rates of the lens.")
    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]] = Field(
        (0.9, 0.999), description="AdamW: decay rates of the means of gradient and squared gradient."
    )
    penalty: Positive = Field(100.0, description="AdamW: weight of the squared violations of limits [1/mm^2].")
    max_incidence_deg: Angle | None = Field(
        None,
        description="AdamW: angle of incidence on a surface above which rays are penalised (paper, 3.3) [degrees].",
    )

    @field_validator("pixels")
    @classmethod
    def _descending(cls, pixels: tuple[float, float]) -> tuple[float, float]:
        if pixels[0] < pixels[1]:
            raise ValueError("expected a first pitch at least as coarse as the last")
        return pixels

    @model_validator(mode="after")
    def _check_keys(self) -> "DescentSettings":
        changed = {key for key, field in type(self).model_fields.items() if getattr(self, key) != field.default}
        for optimizer, keys in OPTIMIZER_KEYS.items():
            for key in keys:
                if optimizer != self.optimizer and key in changed:
                    raise ValueError(f"{key}: only for `optimizer: {optimizer}`, not `{self.optimizer}`")
        for key in ("temperature", "network_learning_rate"):
            if self.criterion != "task" and key in changed:
                raise ValueError(f"{key}: only for `criterion: task`, not `{self.criterion}`")
        for key in _UNREAD.get(self.criterion, ()):
            if key in changed:
                raise ValueError(f"{key}: no effect with `criterion: {self.criterion}`")
        if "final" in changed and self.optimizer == "ray_space" and self.duration == 1 and not self.trains_network:
            raise ValueError("final: no effect in ray space with `duration: 1` and a frozen network")
        return self

    @property
    def reads_images(self) -> bool:
        """True if the criterion judges captures, not rays or PSFs alone."""
        return self.criterion not in _UNREAD

    @property
    def trains_network(self) -> bool:
        """True if the network is trained with the lens."""
        return self.network_learning_rate is not None


def _start(value: Any) -> Any:
    names = value if isinstance(value, list | tuple) else ()
    for name in [value, *names]:
        if isinstance(name, str) and name.endswith((".zmx", ".yaml", ".yml")):
            raise ValueError(
                f"a lens file must be imported first: `imported: {{mine: {{elements: ..., file: {name}}}}}` and "
                "`start: [mine]`"
            )
    if value not in STARTS and not (names and all(isinstance(name, str) for name in names)):
        raise ValueError(f"expected {', '.join(STARTS)}, or a list of designs or imported lenses")
    return value


class GradientDesignSettings(Frozen):
    """Settings of a design by descents: each but the first begins with the best lenses of the one before it."""

    method: Literal["descents"] = Field("descents", description="Design by descents.")
    start: Annotated[Literal["flat", "best_imaging", "best_spot"] | tuple[str, ...], BeforeValidator(_start)] = Field(
        "flat",
        description="flat: flat plates; best_imaging: the imaging lens with the best minival accuracy; best_spot: that "
        "of the lenses by spots or least squares, as in the paper; or a list of designs or imported lenses: the best "
        "of them with the same elements and seed, by the criterion of the last descent or, if that trains a network, "
        "by the minival accuracy of the worst field after fine-tuning.",
    )
    descents: tuple[DescentSettings, ...] = Field(min_length=1, description="Descents, one after another.")
    batch_size: Batch = Field(64, description="Images per step, each at all fields of the step.")
    rays: Rays = Field(256, description="Rays per field and colour, sampled anew at each step.")
    augment: bool = Field(True, description="TrivialAugment on the sharp images.")
    micro_batch: Batch = Field(
        64,
        description="Captures per forward pass; it affects only memory. A network whose batch norms use the "
        "statistics of the batch always takes all captures of a step at once.",
    )
    batch_norm: Literal["stored", "batch"] = Field(
        "stored", description="Statistics of the frozen network's batch norms: stored, or of the batch."
    )
    task: Name | None = Field(
        None,
        description="Task of `tasks.networks` whose network supervises the design in place of the classifier, on "
        "images with objects; null: the classifier.",
    )
    free: dict[VariableName, tuple[SurfaceNumber, ...]] | None = Field(
        None,
        description="Free variables, and their surfaces, numbered from 0; null: all variables of every surface that "
        "refracts. A thickness is the distance behind its surface.",
    )
    keep_apertures: bool = Field(
        False,
        description="Keep the clear apertures of the start, and none elsewhere; an imported lens has one on every "
        "surface. False: they follow from the design.",
    )
    grade: Grade | None = Field(
        None,
        description="Tolerance grade to design for: each step uses a lens built from the design with errors of "
        "its own, and focused; null: the lens as designed.",
    )

    @field_validator("descents")
    @classmethod
    def _decreasing(cls, descents: tuple[DescentSettings, ...]) -> tuple[DescentSettings, ...]:
        for before, after in pairwise(descents):
            if after.lenses > before.lenses:
                raise ValueError(f"lenses: expected at most {before.lenses}, as many as in the previous descent")
        return descents

    @model_validator(mode="after")
    def _check_network(self) -> "GradientDesignSettings":
        if self.task is not None:
            if self.augment or any(descent.size is not None for descent in self.descents):
                raise ValueError("task: expected no `size` and `augment: false`, since masks fit only unchanged images")
            if self.batch_norm == "batch" or any(d.trains_network or d.temperature != 1 for d in self.descents):
                raise ValueError("task: expected a frozen network, `batch_norm: stored`, and no `temperature`")
        if not self.by_network and (self.task is not None or self.batch_norm == "batch"):
            raise ValueError("task, batch_norm: only for designs with a descent of `criterion: task`")
        return self

    @property
    def by_network(self) -> tuple[DescentSettings, ...]:
        """Descents that minimise the loss of a network."""
        return tuple(descent for descent in self.descents if descent.criterion == "task")

    @property
    def starting_designs(self) -> tuple[str, ...]:
        """Names of the designs whose best lens is the start."""
        return self.start if isinstance(self.start, tuple) else ()


def _this_format(value: Any) -> Any:
    if not isinstance(value, dict | GradientDesignSettings | LeastSquaresSettings):
        raise ValueError("expected keys and values")
    method = value.get("method", "descents") if isinstance(value, dict) else value.method
    if method not in ("descents", "least_squares"):
        suffix = f", got {method!r}" if isinstance(method, str) else ""
        raise ValueError(f"method: expected descents (the default) or least_squares{suffix}")
    return value


def _kind(value: Any) -> Any:
    return value.get("method", "descents") if isinstance(value, dict) else getattr(value, "method", None)


DesignSettings = Annotated[
    Annotated[
        Annotated[GradientDesignSettings, Tag("descents")] | Annotated[LeastSquaresSettings, Tag("least_squares")],
        Discriminator(_kind),
    ],
    BeforeValidator(_this_format),
]
