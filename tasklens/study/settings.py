"""What the stages of a study are told: frozen typed classes with units, limits and defaults; no torch here."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, computed_field, field_validator, model_validator

Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]


class Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Spec(Frozen):
    """What every lens of the study has to do; the defaults are the paper's (section 3.3 and 4)."""

    diagonal_mm: Positive = 4.0
    aspect: tuple[Count, Count] = (16, 9)
    field_of_view_deg: Annotated[float, Field(gt=0, lt=150)] = 68.8
    f_number: Positive = 2.8
    pixel_pitch_um: Positive = 1.8
    kernel: Annotated[int, Field(ge=3)] = 51
    wavelengths_um: tuple[Positive, Positive, Positive] = (0.6563, 0.5893, 0.4861)

    @field_validator("wavelengths_um")
    @classmethod
    def _descending(cls, wavelengths: tuple) -> tuple:
        if not wavelengths[0] > wavelengths[1] > wavelengths[2]:
            raise ValueError("expected red, green, blue: descending wavelengths")
        return wavelengths

    @field_validator("kernel")
    @classmethod
    def _odd(cls, kernel: int) -> int:
        if kernel % 2 == 0:
            raise ValueError("expected an odd number, so that the kernel has a central pixel")
        return kernel

    @computed_field
    @property
    def efl_mm(self) -> float:
        """Focal length [mm] that puts the field of view on the diagonal: (d / 2) / tan(FoV / 2)."""
        return self.diagonal_mm / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)

    @computed_field
    @property
    def stop_radius_mm(self) -> float:
        """Radius [mm] of the stop, which stands in front of the lens: EFL / (2 F)."""
        return self.efl_mm / (2 * self.f_number)

    @computed_field
    @property
    def fields_mm(self) -> tuple[tuple[float, float], ...]:
        """Nine field points [mm] on the sensor: {0, 1/2, 1} x {0, 1/2, 1} of its half width and half height."""
        unit = self.diagonal_mm / 2 / math.hypot(*self.aspect)
        width, height = (unit * side for side in self.aspect)
        return tuple((u * width, v * height) for v in (0, 0.5, 1) for u in (0, 0.5, 1))


FLAT_TRACK = 1.3  # from the stop to the image of a flat start, in focal lengths


class Constraints(Frozen):
    """Limits that every design keeps [mm; slope is d sag / d r]: moulded plastic elements in a phone."""

    min_centre_thickness: Positive = 0.25
    max_centre_thickness: Positive = 1.5
    min_edge_thickness: Positive = 0.2
    min_air_gap: Positive = 0.05
    min_back_focus: Positive = 0.7
    max_track: Positive = 4.4
    max_slope: Positive = 0.57
    stop_distance: Positive = 0.1
    efl_tolerance: Fraction = 0.02
    distortion: Fraction = 0.03


RENDERED_CLASSES = 10  # of the built-in pictures, recognition.scenes


class Images(Frozen):
    """The labelled pictures: rendered by us, or read from `folder`: train/<class>/* and test/<class>/* (or val).

    Counts limit what is read from a folder; null means all. The minival is cut out of the training pictures.
    """

    size: Annotated[int, Field(ge=16)] = 64
    train: Count | None = None
    minival: Count = 500
    test: Count | None = None
    seed: int = 0
    folder: Path | None = None

    @model_validator(mode="after")
    def _rendered_need_counts(self):
        if self.folder is None and (self.train is None or self.test is None):
            raise ValueError("rendered images need the counts `train` and `test`")
        if self.folder is None and min(self.train + self.minival, self.test) < RENDERED_CLASSES:
            raise ValueError(f"expected at least {RENDERED_CLASSES} rendered pictures of each split, one per class")
        return self


class Training(Frozen):
    """AdamW with linear warm-up and cosine; weight decay spares biases and norms."""

    epochs: Positive
    rate: Positive
    batch: Count = 64
    weight_decay: Annotated[float, Field(ge=0)] = 0.05
    warmup: Fraction = 0.05


class Classifier(Frozen):
    """A timm network: its name and tag, keywords for `timm.create_model`, and where its weights come from.

    `training` trains it on the sharp images, from `pretrained` (timm's hub), from `weights` (.safetensors; .pth, of
    which only tensors are read; .npz, where timm's model reads it) or from scratch; null takes it as loaded.

    Attributes:
        outputs: one per class of the pictures, or the 1000 of ImageNet, among which folders named by WordNet ids are
            found; the others then take no part but in the zero-shot accuracy.
        processes: that fine-tune it together on one machine, each on its share of every batch, and on a GPU of its own.
    """

    model: str
    arguments: dict[str, Any] = {}
    pretrained: bool = False
    weights: Path | None = None
    outputs: Literal["classes", "imagenet"] = "classes"
    training: Training | None = None
    processes: Count = 1

    @model_validator(mode="after")
    def _one_origin(self):
        if self.pretrained and self.weights:
            raise ValueError("take either `pretrained` or `weights`, not both")
        if not (self.pretrained or self.weights or self.training):
            raise ValueError("expected `pretrained`, `weights` or `training`: an untrained network judges nothing")
        return self


class Restoration(Frozen):
    """NAFNet and its training; the default size is the paper's (section 5.3)."""

    width: Count = 32
    encoder: tuple[Count, ...] = (1, 1, 1, 8)
    middle: Count = 1
    decoder: tuple[Count, ...] = (1, 1, 1, 1)
    steps: Count  # at most: it ends where it has converged
    check: Count = 200  # steps from one look at the minival to the next
    batch: Count = 32
    rate: Positive = 1e-3

    @model_validator(mode="after")
    def _symmetric(self):
        if len(self.encoder) != len(self.decoder):
            raise ValueError("`encoder` and `decoder` need the same number of levels")
        return self

    @property
    def multiple(self) -> int:
        """Image sides must be multiples of this: each encoder level halves them."""
        return 2 ** len(self.encoder)


class Capture(Frozen):
    """How a picture becomes a capture: what the light outside the PSF window does, and where blur is applied."""

    outside: Literal["veil", "renormalise"] = "veil"
    colour: Literal["srgb", "linear"] = "srgb"
