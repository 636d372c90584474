"""Settings of a lens that is designed without a study, and of the lenses that it starts from; no torch here."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field, TypeAdapter, model_validator

from tasklens.fields import GRADING_CENTRES
from tasklens.materials.library import Library
from tasklens.materials.material import Material
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.settings import feasibility, starts
from tasklens.settings.base import Frozen, Name
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_methods import from_flat, methods
from tasklens.settings.design_settings import DesignSettings, GradientDesignSettings
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.layers import check_plain, merged_settings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import LensDesign, LensEntry
from tasklens.settings.messages import validate
from tasklens.settings.network_settings import ClassifierSettings
from tasklens.settings.specification import Constraints, Spec

_ELEMENTS = "lens"  # name of its elements
_RAYS = 4096  # rays per field and colour of its figures, as in a study
TRAINING = ("joint", "end_to_end")  # methods that train the network with the lens
_FIRST = "least_squares"  # designed first if a design starts from the best imaging lens
_FROM_FLAT = ("task", "log_image_error", "correlation")  # methods with the schedule of the studies from flat plates
_SIDE = 64  # of rendered images [pixels]
_BY_NUMBER = (
    'a list replaces all descents; {"descents": {"0": {"steps": 200}}} (--set descents.0.steps=200) changes one'
)


class LensSettings(Frozen):
    """Settings of a lens, of the lenses that it starts from, and of its baselines, in the order of their design."""

    images: ImageSettings = Field(description="Images of the designs.")
    spec: Spec = Field(description="Specification.")
    constraints: Constraints = Field(description="Limits.")
    plastics: tuple[Material, ...] = Field(min_length=1, description="Materials from front to back.")
    designs: dict[Name, DesignSettings] = Field(description="Designs by name; the last is that of the lens.")
    network: ClassifierSettings | None = Field(description="The network, unless it is a module of the user.")

    @model_validator(mode="after")
    def _feasible(self) -> "LensSettings":
        if self.spec.object_distance_mm is not None:
            raise ValueError("spec.object_distance_mm: designs need an object at infinity")
        feasibility.check(_ELEMENTS, "spec", self.plastics, self.spec, self.constraints)
        feasibility.check_window("spec.kernel_size: half of", self.spec.kernel_size, {"images.size": self.images.size})
        if self.network is not None and self.network.outputs != "classes" and self.images.folder is None:
            raise ValueError(
                f"network.outputs: {self.network.outputs!r} needs a folder of photographs, whose classes are named by "
                "WordNet ids"
            )
        for name, design in self.designs.items():
            where = f"designs.{name}"
            if isinstance(design, LeastSquaresSettings) and isinstance(design.spot_um, dict):
                raise ValueError(f"{where}.spot_um: expected a number")
            if isinstance(design, GradientDesignSettings):
                feasibility.check_descents(where, design, self.spec.kernel_size, self.images.size)
                starts.check(where, name, design, self.designs)
        return self

    def plans(self, seed: int) -> dict[str, LensDesign]:
        """Return the settings of each design by the name of its lens."""
        return {f"{_ELEMENTS}-{name}": self._plan(name, design, seed) for name, design in self.designs.items()}

    def _plan(self, name: str, design: DesignSettings, seed: int) -> LensDesign:
        entry = LensEntry(
            name=f"{_ELEMENTS}-{name}", elements=_ELEMENTS, plastics=self.plastics, design_name=name, design=design
        )
        return LensDesign(
            entry=entry,
            spec=self.spec,
            constraints=self.constraints,
            capture=CaptureSettings() if entry.reads_images else None,
            classifier=self.network if entry.by_network else None,
            network=None,
            starts=tuple(f"{_ELEMENTS}-{other}" for other in starts.starting_designs(design, self.designs)),
            fields=None,
            averaged=GRADING_CENTRES,
            rays=_RAYS,
            seed=seed,
        )


def lens_settings(
    method: str,
    elements: Sequence[str],
    spec: Mapping[str, Any],
    settings: Mapping[str, Any],
    constraints: Mapping[str, Any],
    materials: Sequence[str],
    images: Mapping[str, Any] | None,
    classifier: Mapping[str, Any] | None,
    alone: bool = False,
    baselines: Sequence[str] = (),
    network_given: bool = False,
) -> LensSettings:
    """Return the settings of a lens and of the lenses that it starts from.

    Args:
        method: one of `methods`.
        elements: plastics from front to back.
        spec, settings, constraints: changed keys of the specification, of the design, and of the limits.
        materials: files of further plastics.
        images, classifier: keys of `ImageSettings` and `ClassifierSettings`; None: rendered textures, no network.
        alone: leave out the lenses that it starts from, since the start is a lens of the user.
        baselines: criteria without a network; each designs a lens of its name, with the same start and the same effort,
            before the lens of the method.
        network_given: the network is a module of the user.

    Raises:
        InputError: a wrong key or value; the method is unknown, needs a network and there is none, or does not use a
            network or images.
    """
    if method not in methods():
        raise InputError(f"method {method!r}: expected one of {', '.join(methods())}")
    kernel_size = spec.get("kernel_size")
    side = max(_SIDE, kernel_size + 1 if isinstance(kernel_size, int) else 0)
    base = methods()[method]
    if settings.get("start") == "flat" and not alone and method != "spot":  # which always starts from plates
        if method in _FROM_FLAT:
            schedule = from_flat(_SIDE if images is None else images["size"])
            base = schedule if method == "task" else _with_criterion(method, schedule)
        elif "descents" not in settings:
            raise InputError(
                f"method {method}: has no schedule from flat plates; choose {', '.join(_FROM_FLAT)}, or improve their "
                "lens: --start FILE"
            )
    design = merged_settings(base, settings)
    designs = {method: design | {"start": "flat"}} if alone else _with_starts(method, design)
    content = {
        "images": images or {"size": side, "train": 500, "minival": 10, "test": 10},
        "spec": dict(spec),
        "constraints": dict(constraints),
        "plastics": _plastics(elements, materials),
        "network": classifier,
    }
    result = _validate(content | {"designs": designs})
    _check_method(method, result.designs[method])
    if baselines:
        last = designs.pop(method)
        others = {criterion: _with_criterion(criterion, last) for criterion in baselines}
        result = _validate(content | {"designs": designs | others | {method: last}})
    entries = [plan.entry for plan in result.plans(0).values()]
    given, guided = classifier is not None or network_given, any(entry.by_network for entry in entries)
    if guided and not given:
        raise InputError(f"method {method}: needs a network: --network NAME --weights FILE, in Python `network`")
    if given and not guided:
        raise InputError(f"method {method}: has no network; choose task, joint or end_to_end, or give no network")
    if images is not None and not any(entry.reads_images for entry in entries):
        raise InputError(f"method {method}: has no images; choose another method, or give no images")
    return result


def _validate(content: Mapping[str, Any]) -> LensSettings:
    try:
        settings = validate(LensSettings, content)
        check_plain({key: content[key] for key in ("spec", "constraints", "designs")}, "")
    except ValueError as error:
        raise InputError(str(error)) from None
    return settings


def _plastics(elements: Sequence[str], files: Sequence[str]) -> tuple[Material, ...]:
    """Return plastics by their names; raises InputError."""
    library = Library([Path(path) for path in files])
    library.check()
    try:
        return tuple(library.glass(name) for name in elements)
    except FileError as error:
        raise InputError(f"elements: {error}") from None


def _check_method(method: str, design: DesignSettings) -> None:
    """Raise InputError if settings make a method another one: other steps, criterion, or use of the network."""
    own: DesignSettings = TypeAdapter(DesignSettings).validate_python(methods()[method])
    if design.method != own.method:
        raise InputError(f"method {method}: expected its own settings, got `method: {design.method}`; omit this key")
    if not (isinstance(design, GradientDesignSettings) and isinstance(own, GradientDesignSettings)):
        return
    last, criterion = design.descents[-1], own.descents[-1].criterion
    if last.criterion != criterion:
        raise InputError(
            f"method {method}: expected `criterion: {criterion}` in its last descent, got {last.criterion}; "
            f"{_BY_NUMBER}"
        )
    if design.by_network and not own.by_network:
        raise InputError(f"method {method}: expected descents without a network, got `criterion: task`; {_BY_NUMBER}")
    if method in TRAINING and not last.trains_network:
        raise InputError(
            f"method {method}: expected a network_learning_rate in its last descent, since it trains the network, got "
            f"none; {_BY_NUMBER}; the method task does not train it"
        )
    if method not in TRAINING and any(part.trains_network for part in design.descents):
        raise InputError(f"network_learning_rate: only with the methods {' and '.join(TRAINING)}, not {method}")


def _with_criterion(criterion: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a design by another criterion, with the same start, steps and images."""
    network_keys = ("criterion", "network_learning_rate", "temperature", "batch_norm", "task")
    descents = [{k: v for k, v in descent.items() if k not in network_keys} for descent in settings["descents"]]
    kept = {key: value for key, value in settings.items() if key not in network_keys}
    return kept | {"descents": [descent | {"criterion": criterion} for descent in descents]}


def _with_starts(method: str, settings: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return a design, preceded by the designs that it starts from, and these by theirs."""
    first = [_FIRST] if settings.get("start") in ("best_imaging", "best_spot") else settings.get("start", [])
    designs: dict[str, Mapping[str, Any]] = {}
    for name in first if isinstance(first, list) else []:
        if name not in methods() or name == method:
            raise InputError(f"start: {name!r} is not one of the other methods {', '.join(methods())}")
        designs = _with_starts(name, methods()[name]) | designs
    return {**designs, method: settings}
