"""Base class of all settings, and kinds of numbers and names in them; no torch here.

Bounds are far from all practical values. They reject, before the first job, values that would fail hours later, fill
the memory, or never end.
"""

from typing import Annotated, Any, ClassVar, Never

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field


class Frozen(BaseModel):
    """Base class of all settings: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class WithoutDescents(Frozen):
    """Base class of designs without descents: what readers of all designs ask for is empty."""

    descents: ClassVar[tuple[Never, ...]] = ()
    by_network: ClassVar[tuple[Never, ...]] = ()
    starting_designs: ClassVar[tuple[Never, ...]] = ()
    start: ClassVar[None] = None
    task: ClassVar[None] = None
    free: ClassVar[None] = None


def _no_truth(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a whole number")
    return value


def _rising(periods: tuple[float, float]) -> tuple[float, float]:
    if not periods[0] < periods[1]:
        raise ValueError("expected a shorter and a longer period")
    return periods


Whole = Annotated[int, BeforeValidator(_no_truth)]  # not `true`, which is 1
Count = Annotated[Whole, Field(gt=0, le=10**9)]
Small = Annotated[Whole, Field(gt=0, le=1000)]  # levels, blocks: one object each
Batch = Annotated[Whole, Field(gt=0, le=2**16)]  # images at once: 10 GB with 224 pixels
Rays = Annotated[Whole, Field(gt=0, le=2**20)]  # per field and colour: 10 GB
Steps = Annotated[Whole, Field(gt=0, le=10**8)]  # ten days at 10 ms each
Seed = Annotated[Whole, Field(ge=0, lt=2**31)]  # descents multiply it by their steps
Fraction = Annotated[float, Field(ge=0, le=1)]
Part = Annotated[float, Field(gt=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e12)]
Length = Annotated[float, Field(gt=0, le=1000)]  # [mm]
Micrometres = Annotated[float, Field(ge=0.01, le=1000)]
LearningRate = Annotated[float, Field(gt=0, le=10)]
Magnification = Annotated[float, Field(ge=1, le=1000)]
Periods = Annotated[  # of rendered textures [pixels]
    tuple[Annotated[float, Field(ge=3)], Annotated[float, Field(le=10_000)]], AfterValidator(_rising)
]
Angle = Annotated[float, Field(gt=0, lt=90)]  # [degrees]
# The name of a file contains up to four of these names, and file systems allow 255 bytes.
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$", max_length=40)]
StudyName = Annotated[  # study/key=value at a point of a sweep
    str, Field(pattern=r"^[a-z0-9_]+(/[\w.]+=[\w.=+-]+)?$", max_length=200)
]
