"""Request for the design of one lens, from Python or from the command line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from torch import nn

from tasklens.design.supervision import Loss
from tasklens.optics.lens import Lens
from tasklens.optics.view import View


class Specification(TypedDict, total=False):
    """Keys of `Spec`, and of the file of a lens that is improved; None for the default, or the value of the file."""

    f_number: float | None
    field_of_view_deg: float | None
    diagonal_mm: float | None
    aspect: tuple[float, float] | None
    pixel_pitch_um: float | None
    kernel_size: int | None
    wavelengths_um: Sequence[float] | Sequence[str] | None
    object_distance_mm: float | None
    configuration: int | None


@dataclass(frozen=True)
class LensRequest:
    """One lens to design; `design_lens` explains each value."""

    method: str | None = None
    elements: Sequence[str] | None = None
    seed: int = 0
    settings: Mapping[str, Any] | None = None
    constraints: Mapping[str, Any] | None = None
    catalogues: str | Path | Sequence[str | Path] = ()
    images: Any = None
    size: int | None = None
    network: nn.Module | Mapping[str, Any] | None = None
    loss: Loss | None = None
    start: str | Path | tuple[Lens, View] | None = None
    free: Mapping[str, Sequence[int] | None] | None = None
    spec: Specification = field(default_factory=Specification)
