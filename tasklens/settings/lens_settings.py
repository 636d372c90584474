"""Designs of a lens without a study, and of the lenses that it starts from; no torch here."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from pydantic import Field, TypeAdapter, model_validator

from tasklens.fields import GRADING_CENTRES
from tasklens.materials.material import Material
from tasklens.runtime.errors import InputError
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

ELEMENTS = "lens"  # name of its elements
_RAYS = 4096  # rays per field and colour of its figures, as in a study
TRAINING = ("joint", "end_to_end")  # methods that train the network with the lens
_FIRST = "least_squares"  # designed first if a design starts from the best imaging lens
_FROM_FLAT = ("task", "log_image_error", "correlation")  # methods with the schedule of the studies from flat plates
_SIDE = 64  # of rendered images [pixels]
_BY_NUMBER = (
    'a list replaces all descents; {"descents": {"0": {"steps": 200}}} (--set descents.0.steps=200) changes one'
)


class LensSettings(Frozen):
    """Designs of a lens, of the lenses that it starts from, and of its baselines, in the order of their design."""

    images: ImageSettings = Field(description="Images of the designs.")
    designs: dict[Name, DesignSettings] = Field(description="Designs by name; the last is that of the lens.")
    network: ClassifierSettings | None = Field(description="The network, unless it is a module of the user.")

    @model_validator(mode="after")
    def _consistent(self) -> "LensSettings":
        if self.network is not None and self.network.outputs != "classes" and self.images.folder is None:
            raise ValueError(
                f"network.outputs: {self.network.outputs!r} needs a folder of photographs, whose classes are named by "
                "WordNet ids"
            )
        for name, design in self.designs.items():
            if isinstance(design, LeastSquaresSettings) and isinstance(design.spot_um, dict):
                raise ValueError(f"designs.{name}.spot_um: expected a number")
            if isinstance(design, GradientDesignSettings):
                starts.check(f"designs.{name}", name, design, self.designs)
        return self

    def plans(
        self,
        plastics: tuple[Material, ...],
        spec: Spec,
        constraints: Constraints,
        seed: int,
        given: Collection[str] = (),
    ) -> dict[str, LensDesign]:
        """Return the settings of each design by the name of its lens.

        Args:
            plastics: materials from front to back.
            given: names of the lenses that all designs start from, in place of those in their settings.

        Raises:
            InputError: the images do not fit the PSF window, or the steps of a design.
        """
        feasibility.check_window("spec.kernel_size: half of", spec.kernel_size, {"images.size": self.images.size})
        plans = {}
        for name, design in self.designs.items():
            if isinstance(design, GradientDesignSettings):
                feasibility.check_descents(f"designs.{name}", design, spec.kernel_size, self.images.size)
            entry = LensEntry(
                name=f"{ELEMENTS}-{name}", elements=ELEMENTS, plastics=plastics, design_name=name, design=design
            )
            others = (f"{ELEMENTS}-{other}" for other in starts.starting_designs(design, self.designs))
            plans[entry.name] = LensDesign(
                entry=entry,
                spec=spec,
                constraints=constraints,
                capture=CaptureSettings() if entry.reads_images else None,
                classifier=self.network if entry.by_network else None,
                network=None,
                starts=tuple(given or others),
                fields=None,
                averaged=GRADING_CENTRES,
                rays=_RAYS,
                seed=seed,
            )
        return plans


def lens_settings(
    method: str,
    designs: Mapping[str, Mapping[str, Any]],
    kernel_size: int,
    images: Mapping[str, Any] | None,
    network: Any,
    baselines: Sequence[str] = (),
) -> LensSettings:
    """Return the settings of the designs of a lens by one of `methods`, with its baselines.

    Args:
        designs: keys of the designs by name; the last is by the method.
        kernel_size: width of the PSF window [pixels].
        images: keys of `ImageSettings`; None: rendered textures, larger than the PSF window.
        network: keys of `ClassifierSettings`, or a module of the user; None: no network.
        baselines: criteria without a network; each designs a lens of its name, with the same start and the same effort,
            before the lens of the method.

    Raises:
        InputError: a wrong key or value; the method needs a network and there is none, or does not use a network or
            images.
    """
    content = {
        "images": images or {"size": max(_SIDE, kernel_size + 1), "train": 500, "minival": 10, "test": 10},
        "network": network if isinstance(network, Mapping) else None,
    }
    result = validate(LensSettings, content | {"designs": designs})
    check_plain(designs, "designs")
    _check_method(method, result.designs[method])
    if baselines:
        others = {name: design for name, design in designs.items() if name != method}
        if both := others.keys() & {*baselines}:
            raise InputError(
                f"start: {min(both)} is a lens of the verdict, too; choose another start, or no verdict (--no-verdict)"
            )
        others |= {criterion: _with_criterion(criterion, designs[method]) for criterion in baselines}
        result = validate(LensSettings, content | {"designs": others | {method: designs[method]}})
    descents = [part for design in result.designs.values() for part in design.descents]
    guided = any(part.criterion == "task" for part in descents)
    if guided and network is None:
        raise InputError(f"method {method}: needs a network: --network NAME --weights FILE, in Python `network`")
    if network is not None and not guided:
        raise InputError(f"method {method}: has no network; choose task, joint or end_to_end, or give no network")
    if images is not None and not any(part.reads_images for part in descents):
        raise InputError(f"method {method}: has no images; choose another method, or give no images")
    return result


def method_settings(method: str) -> dict[str, Any]:
    """Return the keys of a design by one of `methods`; raises InputError for another name."""
    if method not in methods():
        raise InputError(f"method {method!r}: expected one of {', '.join(methods())}")
    return methods()[method]


def with_starts(
    method: str, settings: Mapping[str, Any], images: Mapping[str, Any] | None
) -> dict[str, Mapping[str, Any]]:
    """Return the keys of a design by a method, preceded by those of the designs that it starts from, in turn.

    Args:
        settings: keys of the design that differ from the method's; from flat plates some methods have a schedule.
        images: keys of `ImageSettings`; None: rendered textures.

    Raises:
        InputError: there is no such method, no such start, or no schedule from flat plates.
    """
    base = method_settings(method)
    if settings.get("start") == "flat" and method != "spot":  # which always starts from plates
        if method in _FROM_FLAT:
            schedule = from_flat(_SIDE if images is None else images["size"])
            base = schedule if method == "task" else _with_criterion(method, schedule)
        elif "descents" not in settings:
            raise InputError(
                f"method {method}: has no schedule from flat plates; choose {', '.join(_FROM_FLAT)}, or improve their "
                "lens: --start FILE"
            )
    design = merged_settings(base, settings)
    first = [_FIRST] if design.get("start") in ("best_imaging", "best_spot") else design.get("start", [])
    designs: dict[str, Mapping[str, Any]] = {}
    for name in first if isinstance(first, list | tuple) else []:
        if name not in methods() or name == method:
            raise InputError(f"start: {name!r} is not one of the other methods {', '.join(methods())}")
        designs = with_starts(name, {}, images) | designs
    return {**designs, method: design}


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
