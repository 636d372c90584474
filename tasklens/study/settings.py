"""Settings of a study: frozen, typed, with units, limits and defaults; no torch here."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    computed_field,
    field_validator,
    model_validator,
)

from tasklens.fields import PAPER
from tasklens.runtime.errors import InputError
from tasklens.study import user_code
from tasklens.study.frozen import Frozen
from tasklens.study.quantities import (
    Angle,
    Batch,
    Count,
    Fraction,
    LearningRate,
    Length,
    Magnification,
    Micrometres,
    Periods,
    Seed,
    Small,
    Whole,
)


class Spec(Frozen):
    """Specification of lenses; the defaults are those of Yang et al. 2024, sections 3.3 and 4."""

    diagonal_mm: Length = Field(4.0, description="Diagonal of the sensor [mm].")
    aspect: tuple[Small, Small] = Field((16, 9), description="Width to height of the sensor.")
    field_of_view_deg: float = Field(68.8, ge=0.1, lt=150, description="Full field of view on the diagonal [degrees].")
    f_number: float = Field(  # at 0.5 the marginal ray of a lens free of coma is at right angles to the axis
        2.8, ge=0.5, le=100, description="Focal length over diameter of the entrance pupil."
    )
    pixel_pitch_um: Micrometres = Field(1.8, description="Pixel pitch [um].")
    kernel_size: Whole = Field(51, ge=3, description="Width of the square PSF window [pixels], odd.")
    wavelengths_um: tuple[Micrometres, Micrometres, Micrometres] = Field(
        (0.6563, 0.5893, 0.4861),
        description="Red, green and blue [um]; the middle one is the reference. C, D, F lines.",
    )
    object_distance_mm: float | None = Field(
        None,
        ge=1,
        le=1e9,
        description="Distance of the object from the first vertex [mm], for imported lenses; null: infinity.",
    )

    @field_validator("wavelengths_um")
    @classmethod
    def _descending(cls, wavelengths: tuple[float, float, float]) -> tuple[float, float, float]:
        if not wavelengths[0] > wavelengths[1] > wavelengths[2]:
            raise ValueError("expected red, green, blue: descending wavelengths")
        return wavelengths

    @field_validator("kernel_size")
    @classmethod
    def _odd(cls, kernel_size: int) -> int:
        if kernel_size % 2 == 0:
            raise ValueError("expected an odd number, so that the PSF has a central pixel")
        return kernel_size

    @computed_field
    @property
    def efl_mm(self) -> float:
        """Focal length [mm] that puts the field of view on the diagonal: (d / 2) / tan(FoV / 2)."""
        return self.diagonal_mm / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)

    @computed_field
    @property
    def stop_radius_mm(self) -> float:
        """Radius [mm] of the stop, which is in front of the lens: EFL / (2 F)."""
        return self.efl_mm / (2 * self.f_number)

    @computed_field
    @property
    def fields_mm(self) -> tuple[tuple[float, float], ...]:
        """Nine fields f tan(theta) [mm]: {0, 1/2, 1} x {0, 1/2, 1} of the half width and half height of the sensor."""
        unit = self.diagonal_mm / 2 / math.hypot(*self.aspect)
        width, height = (unit * side for side in self.aspect)
        return tuple((u * width, v * height) for u, v in PAPER)


class Constraints(Frozen):
    """Limits of a design [mm; slope is d sag / d r], for moulded plastic elements in a phone.

    They are our choice: the paper states none.
    """

    min_centre_thickness: Length = Field(0.25, description="Least centre thickness of an element [mm].")
    max_centre_thickness: Length = Field(1.5, description="Largest centre thickness of an element [mm].")
    min_edge_thickness: Length = Field(0.2, description="Least thickness of an element within its aperture [mm].")
    min_air_gap: Length = Field(0.05, description="Least air space between elements within their apertures [mm].")
    min_back_focus: Length = Field(0.7, description="Least distance from the last surface to the sensor [mm].")
    max_track: Length = Field(4.4, description="Largest distance from the stop to the sensor [mm].")
    max_slope: float = Field(0.57, gt=0, le=100, description="Largest slope d sag / d r of a surface.")
    stop_distance: Length = Field(0.1, description="Distance from the stop to the first surface [mm].")
    flat_track: float = Field(
        1.3, gt=0, le=100, description="Distance from the stop to the sensor of a flat start [focal lengths]."
    )
    efl_tolerance: Fraction = Field(0.02, description="Largest deviation of the focal length, as a fraction.")
    distortion: Fraction = Field(
        0.03, description="Largest distortion, a fraction of the image height at the specified focal length."
    )
    max_chief_ray_angle_deg: Angle | None = Field(
        None, description="Largest chief ray angle on the sensor [degrees]; null: no limit, as in the paper."
    )


RENDERED_CLASSES = 10  # a copy of len(scenes.CLASSES), whose module imports torch


class ImageSettings(Frozen):
    """Settings of labelled images: rendered, or read from `folder`: train/<class>/* and test/<class>/* (or val).

    A folder with only <class>/* is split into test, minival and training images.
    """

    size: Whole = Field(64, ge=16, le=8192, description="Side of the square images [pixels].")
    train: Count | None = Field(None, description="Number of training images; for a folder the maximum, null: all.")
    minival: Count = Field(500, description="Number of validation images, held out from training.")
    test: Count | None = Field(None, description="Number of test images; for a folder the maximum, null: all.")
    seed: Seed = Field(0, description="Seed of the rendering, or of the choice and split of a folder's images.")
    folder: Path | None = Field(None, description="Folder of photographs; null: rendered textures.")
    periods: Periods = Field(
        (5.0, 16.0), description="Shortest and longest period of rendered textures [pixels]; shorter ones are harder."
    )

    @model_validator(mode="after")
    def _rendered_need_counts(self) -> "ImageSettings":
        if self.folder is not None:
            return self
        if self.train is None or self.test is None:
            raise ValueError("rendered images need the counts `train` and `test`")
        if (count := self.train + self.minival + self.test) * 3 * self.size**2 > 1e12:
            raise ValueError(
                f"expected rendered images of at most 1 TB, got {count} of {self.size} x {self.size} pixels"
            )
        if min(self.train + self.minival, self.test) < RENDERED_CLASSES:
            raise ValueError(f"expected at least {RENDERED_CLASSES} rendered images of each split, one per class")
        return self


class TrainingSettings(Frozen):
    """Settings of AdamW with linear warm-up and cosine schedule; biases and norms have no weight decay."""

    epochs: float = Field(
        ge=0,
        le=10_000,
        description="Epochs, possibly fractional; 0: no training, as in a zero-shot study.",
    )
    learning_rate: LearningRate = Field(description="Largest learning rate, after the warm-up.")
    batch_size: Batch = Field(64, description="Images per step.")
    weight_decay: float = Field(
        0.05, ge=0, le=100, description="Weight decay of AdamW; not of biases, norms and what timm's models exempt."
    )
    warmup: Fraction = Field(0.05, description="Fraction of the steps in which the learning rate rises linearly.")


class ClassifierSettings(Frozen):
    """Settings of a timm network: its name and tag, keywords for `timm.create_model`, and the source of its weights."""

    model: str = Field(
        description="timm's name of the network, with the tag of its weights; or `package.module:function`, a function "
        "of your own that takes `num_classes` and returns a module for images in [0, 1]."
    )
    arguments: dict[str, Any] = Field(
        {},
        description="Keywords for `timm.create_model`, such as a smaller width, or for your function. "
        "`pretrained_cfg_overlay: {mean: [0.5, 0.5, 0.5], std: [0.5, 0.5, 0.5]}` sets another normalisation.",
    )
    seed: Seed = Field(0, description="Seed of its initial weights, and of its training on sharp images.")
    pretrained: bool = Field(False, description="Start from the weights of timm's hub.")
    weights: Path | None = Field(
        None,
        description="Start from a local file: .safetensors; .pth, of which only tensors are read; .npz, if timm's "
        "model reads it.",
    )
    outputs: Literal["classes", "imagenet", "all_imagenet"] = Field(
        "classes",
        description="classes: one output per class of the images; imagenet: ImageNet's 1000 outputs, of which only "
        "those of the folders, named by WordNet ids, are used, while the others count only in the zero-shot accuracy; "
        "all_imagenet: any of the 1000 may be the answer, right or wrong.",
    )
    training: TrainingSettings | None = Field(None, description="Training on the sharp images; null: none.")
    processes: Small = Field(
        1,
        description="Size of the process group for fine-tuning on one machine; each process takes its share of every "
        "batch, and its own GPU if there are GPUs.",
    )

    @computed_field
    @property
    def code(self) -> str | None:
        """Digest of the file of a user's function."""
        return user_code.digest(self.model)

    @model_validator(mode="after")
    def _one_origin(self) -> "ClassifierSettings":
        if self.pretrained and self.weights:
            raise ValueError("expected either `pretrained` or `weights`, not both")
        if self.pretrained and user_code.is_users(self.model):
            raise ValueError("pretrained: only for networks of timm; your function may load weights, or `weights`")
        trained = self.pretrained or self.weights or (self.training and self.training.epochs)
        if not trained and not user_code.is_users(self.model):  # a function may return a trained network
            raise ValueError("expected `pretrained`, `weights` or `training`: an untrained network classifies nothing")
        return self


class SensorSettings(Frozen):
    """Settings of a sensor's noise and levels; the defaults are our choice, typical of a phone in daylight."""

    full_well: float = Field(6000, ge=1, le=1e9, description="Electrons per pixel at white with gain 1.")
    gain: Magnification = Field(1, description="Gain: white is at full_well / gain electrons; about 16 indoors.")
    read_noise: float = Field(2, ge=0, le=1e6, description="Standard deviation of the read noise [electrons].")
    bits: Annotated[Whole, Field(ge=1, le=16)] = Field(8, description="Bits of the sRGB values.")


class CaptureSettings(Frozen):
    """Settings of captures: light outside the PSF window, colour values that are convolved, diffraction, the sensor."""

    outside_window: Literal["veil", "renormalise"] = Field(
        "veil",
        description="Light outside the PSF window. veil: a uniform veil that conserves the mean; renormalise: removed "
        "by renormalising the PSF, as in the authors' code.",
    )
    colour: Literal["srgb", "linear"] = Field(
        "srgb",
        description="srgb: convolution of sRGB values, our reading of the paper; linear: of linear light, as in a "
        "camera, the default with a `sensor`.",
    )
    sensor: SensorSettings | None = Field(
        None,
        description="Shot noise, read noise and rounding, at the lens' relative illumination, which is corrected "
        "afterwards; in design, training and measurement; null: none.",
    )
    diffraction: bool = Field(
        False, description="Include diffraction in the PSFs of training and measurement; designs are geometric."
    )

    def check_new_sensor(self, changes: Mapping[str, Any], where: str) -> None:
        """Check that changes which add a sensor say what is blurred, unless these settings do; raises InputError.

        The default of `colour` depends on the sensor, and has already been applied.
        """
        adds = self.sensor is None and changes.get("sensor") is not None
        if adds and "colour" not in changes and "colour" not in self.model_fields_set:
            raise InputError(f"{where}: adds a sensor; also give `colour`, linear as in a camera, or srgb")

    @model_validator(mode="before")
    @classmethod
    def _default_colour(cls, values: Any) -> Any:
        """Take linear light by default with a sensor: its noise is that of light."""
        if isinstance(values, dict) and values.get("sensor") is not None and "colour" not in values:
            return values | {"colour": "linear"}
        return values


class RankingSettings(Frozen):
    """Facts of the lenses of a study that `tasklens rank` adds to their files."""

    titles: dict[str, str] = Field({}, description="Display names of lenses, by lens.")
    left_out: dict[str, str] = Field({}, description="Lenses that are not measured, with the reason.")
    mtf: dict[str, float] = Field({}, description="Mean MTF of lenses, by which the sieve chose them.")
    built: tuple[str, ...] = Field((), description="Lenses to build in simulation.")
