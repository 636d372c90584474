"""A study of one lens, for a design without a study file; no torch here."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter

from tasklens.runtime.errors import InputError
from tasklens.settings.design_settings import DesignSettings, GradientDesignSettings
from tasklens.settings.layers import merged_settings
from tasklens.study.design_methods import from_flat, methods
from tasklens.study.loading import parse
from tasklens.study.study import Study

ELEMENTS = "lens"  # name of its elements
NETWORK = "network"
TRAINING = ("joint", "end_to_end")  # methods that train the network with the lens
_FIRST = "least_squares"  # designed first if a design starts from the best imaging lens
_FROM_FLAT = ("task", "log_image_error", "correlation")  # methods with the schedule of the studies from flat plates
_SIDE = 64  # of rendered images [pixels]
_BY_NUMBER = (
    'a list replaces all descents; {"descents": {"0": {"steps": 200}}} (--set descents.0.steps=200) changes one'
)


def study(
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
) -> Study:
    """Return a study of the lens and of the lenses that it starts from, in the order of their design.

    Args:
        method: one of `methods`.
        elements: plastics from front to back.
        spec, settings, constraints: changed keys of `spec`, of the design, and of `constraints`.
        materials: files of further plastics.
        images, classifier: sections of a study file; None: rendered textures, no network.
        alone: leave out the lenses that it starts from, since the start is a lens of the user.
        baselines: criteria without a network; each designs a lens of its name, with the same start and the same effort,
            before the lens of the method.
        network_given: the network is a module of the user.

    Raises:
        StudyError: a wrong key or value.
        InputError: the method is unknown, needs a network and there is none, or does not use a network or images.
    """
    if method not in methods():
        raise InputError(f"method {method!r}: expected one of {', '.join(methods())}")
    kernel_size = spec.get("kernel_size")
    side = max(_SIDE, kernel_size + 1 if isinstance(kernel_size, int) else 0)
    images_of_study = images or {"size": side, "train": 500, "minival": 10, "test": 10}
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
        "format": 3,
        "name": "one",
        "images": images_of_study,
        "spec": dict(spec),
        "constraints": dict(constraints),
        "elements": {ELEMENTS: list(elements)},
        "materials": list(materials),
        "designs": designs,
        "supervisor": NETWORK,
        "classifiers": {NETWORK: classifier or {"model": "none", "pretrained": True}},
        "fine_tuning": {"epochs": 0, "learning_rate": 1e-3},
        "restoration": {"steps": 1, "encoder": [1], "decoder": [1]},
    }
    result = parse(content)
    _check_method(method, result.designs[method])
    if baselines:
        last = designs.pop(method)
        others = {criterion: _with_criterion(criterion, last) for criterion in baselines}
        result = parse(content | {"designs": designs | others | {method: last}})
    given, classified = classifier is not None or network_given, any(lens.classified for lens in result.lenses.values())
    if classified and not given:
        raise InputError(f"method {method}: needs a network: --network NAME --weights FILE, in Python `network`")
    if given and not classified:
        raise InputError(f"method {method}: has no network; choose task, joint or end_to_end, or give no network")
    if images is not None and not any(lens.reads_images for lens in result.lenses.values()):
        raise InputError(f"method {method}: has no images; choose another method, or give no images")
    return result


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
