"""Design of one lens without a study."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from torch import nn

from tasklens.design import chain, from_lens
from tasklens.design.chain import Designs
from tasklens.design.supervision import Loss, Supervision, UserTask
from tasklens.materials.library import Library, user_files
from tasklens.materials.material import Material
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.recognition import pairs
from tasklens.recognition.dataset import MAX_IMAGES, PHOTOGRAPH_SIZE, ImageDataset, training_count
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, as_paths
from tasklens.settings import feasibility
from tasklens.settings.lens_settings import ELEMENTS, lens_settings, with_starts
from tasklens.settings.messages import validate
from tasklens.settings.specification import Constraints, Spec

_ELEMENTS = ("COC", "OKP4")
_OF_THE_START = ("elements", "diagonal_mm", "aspect")  # what a lens that is improved keeps
BASELINES = ("log_image_error", "correlation")  # criteria of image quality that a design is compared with


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


def designs(
    request: LensRequest,
    held_out: bool = False,
    baselines: Sequence[str] = (),
    remark: Callable[[str], None] = warnings.warn,
) -> Designs:
    """Design one lens, its starting lenses, and the baselines that it is compared with.

    Args:
        held_out: keep photographs apart for a comparison (see `dataset.unused_images`).
        baselines: criteria of image quality. One lens is designed by each, with the same start and the same effort.
        remark: callback for each assumption about the lens of `start`, as text, before the design.
    """
    start, settings, constraints = request.start, request.settings or {}, request.constraints or {}
    method = request.method or ("least_squares" if start is None else "spot")
    if start == "flat":
        settings, start = {**settings, "start": "flat"}, None
    spec_keys = {key: value for key, value in request.spec.items() if value is not None}
    if request.loss is not None and request.network is None:
        raise InputError("loss: only with a `network`; omit it, or give one")
    if request.loss is not None:  # labels may be masks or positions, which augmentation would not move
        settings = {"augment": False, **settings}
    images, dataset = _images(request.images, request.size, held_out)
    module = None if isinstance(request.network, Mapping) else request.network
    user = Supervision(dataset, module, None if request.loss is None else UserTask(request.loss))
    catalogues = [*as_paths(request.catalogues, "catalogues"), *user_files()]
    given: dict[str, Lens] = {}
    if start is None:
        if request.free is not None:
            raise InputError("free: only with `start`, the file of a lens")
        spec, limits = validate(Spec, spec_keys, "spec"), validate(Constraints, constraints, "constraints")
        if spec.object_distance_mm is not None:
            raise InputError("spec.object_distance_mm: designs need an object at infinity")
        plastics = _plastics(_ELEMENTS if request.elements is None else request.elements, catalogues)
        feasibility.check(ELEMENTS, "spec", plastics, spec, limits)
        keys = with_starts(method, settings, images)
    else:
        for key, value in {"elements": request.elements, **spec_keys}.items():
            if value is not None and key in _OF_THE_START:
                raise InputError(f"{key}: not with `start`, whose lens has its own")
        file = from_lens.read_start(start, catalogues, spec_keys)
        own, spec, limits, view = from_lens.improvement(file, method, settings, request.free, constraints, remark)
        keys, plastics, given = {method: own}, tuple(dict.fromkeys(file.lens.media)), {"start": file.lens}
    chosen = lens_settings(method, keys, spec.kernel_size, images, request.network, baselines)
    result = chain.design(chosen.plans(plastics, spec, limits, request.seed, given), chosen.images, user, given)
    if start is None:
        return result
    if isinstance(start, str | Path):
        result.notes["origin"]["start"] = str(Path(start))
    return from_lens.finished(result, file, view, set(spec_keys), remark)


def _plastics(elements: Sequence[str], catalogues: Sequence[Path]) -> tuple[Material, ...]:
    """Return plastics by their names; raises InputError."""
    if not elements:
        raise InputError("elements: expected at least one plastic")
    library = Library(catalogues)
    library.check()
    try:
        return tuple(library.glass(name) for name in elements)
    except FileError as error:
        raise InputError(f"elements: {error}") from None


def _images(images: Any, size: int | None, held_out: bool) -> tuple[dict[str, Any] | None, ImageDataset | None]:
    """Return the settings of the images, and the data set of a user in Python; None for the absent one."""
    if size is not None and not isinstance(images, str | Path):
        raise InputError("size: only for a folder of photographs, `images` (--images)")
    if images is None:
        return None, None
    if not isinstance(images, str | Path):
        dataset = pairs.of_pairs(images, MAX_IMAGES)
        count = max(len(dataset), 10)
        return {"size": dataset.images.shape[-1], "train": count, "minival": 2, "test": 10}, dataset
    side, count = PHOTOGRAPH_SIZE if size is None else size, training_count(Path(images), held_out)
    return {"folder": str(images), "size": side, "train": count, "minival": 2}, None
