"""Files of new studies: the default study with a user's options, reduced by cuts to a time budget."""

import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from tasklens.recognition import class_folders
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import write_text
from tasklens.settings.design_methods import with_named_designs
from tasklens.settings.image_settings import RENDERED_CLASSES
from tasklens.settings.layers import merged_settings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.study.loading import load, parse
from tasklens.study.run import planning
from tasklens.study.run.changes import in_one_line
from tasklens.study.run.digest import NOT_INSTALLED, ROOT
from tasklens.study.run.forecast import COMPARABLE, LARGE, duration, durations_of

DEFAULT = ROOT / "config" / "config.yaml"
_OF_LARGE_IMAGES = {
    "photographs.yaml": ("designs", "fine_tuning", "restoration"),
    "photographs_fine_tuned.yaml": ("fine_tuning",),
}
_CORE = ("tasklens", "image_psnr", "image_correlation", "imaging2", "imaging3")
_LEAST = ("tasklens", "image_psnr", "imaging2")
_WIDTH = 120  # of a line


@cache
def default_study() -> dict[str, Any]:
    """Return the keys of the default study; raises InputError if the studies are not installed."""
    if not DEFAULT.is_file():
        raise InputError(f"{DEFAULT}: {NOT_INSTALLED}")
    return with_named_designs(yaml.safe_load(DEFAULT.read_text(encoding="utf-8")))


def _counts(folder: Path, minival: int, fraction: float) -> dict[str, int]:
    """Return image counts: at most a fifth of the training images for minival; without splits, a fifth to test."""
    if split := class_folders.is_split(folder):
        folders = class_folders.train_folder(folder), class_folders.test_folder(folder)
        train, test = (class_folders.count(place, COMPARABLE) for place in folders)
    else:
        total = class_folders.count(folder, COMPARABLE)
        test = total // 5
        train = total - test
    counts = {"minival": max(2, min(minival, train // 5))}
    if fraction < 1:
        counts["train"] = max(1, round((train - counts["minival"]) * fraction))
    if fraction < 1 or not split:
        counts["test"] = max(1, round(test * fraction))
    return counts


def elements() -> dict[str, list[str]]:
    """Return the plastics of each named set of elements: a singlet, and the sets of the default study."""
    return {"singlet": ["COC"]} | default_study()["elements"]


@dataclass(frozen=True)
class Cut:
    """A part of the default study: tables, designs (None: all), and a fraction of steps and images."""

    words: str
    tables: tuple[str, ...]
    designs: tuple[str, ...] | None = None
    fraction: float = 1.0


CUTS = (
    Cut("all four tables", ("table1", "table2", "table3", "table4")),
    Cut("tables 1 to 3, without restoration", ("table1", "table2", "table3")),
    Cut("tables 1 and 3, with one network", ("table1", "table3")),
    Cut("table 1, without spot and end-to-end designs", ("table1",), _CORE),
    Cut("table 1 with three designs", ("table1",), _LEAST),
    Cut("table 1 with three designs and a quarter of their steps and images", ("table1",), _LEAST, 0.25),
)


@dataclass(frozen=True)
class StudyRequest:
    """Options of `tasklens study new`.

    Attributes:
        folder: folder of photographs; None for the rendered images.
        networks: names of networks of the default study, or of timm, which start from published weights; the first one
            supervises the designs.
        elements: plastics from front to back by name.
        weights: weights of the first network, if it is from timm, instead of published ones; it is not trained.
        outputs, arguments: of this network, as in `ClassifierSettings`.
    """

    name: str
    folder: Path | None
    size: int
    networks: tuple[str, ...]
    elements: Mapping[str, Sequence[str]]
    f_number: float
    field_of_view_deg: float
    seeds: int
    weights: Path | None = None
    outputs: str = "classes"
    arguments: Mapping[str, Any] = field(default_factory=dict)


def content(request: StudyRequest, cut: Cut) -> dict[str, Any]:
    """Return the keys of the study file: the default study with the requested options, reduced by a cut."""
    base = _base(request.size)
    networks = [re.sub("[^a-z0-9_]", "_", network.lower()) for network in request.networks]  # resnet18.a1_in1k
    designs = {name: _design(base["designs"], name, cut) for name in cut.designs or base["designs"]}
    images: dict[str, Any] = {"size": request.size, "minival": base["images"]["minival"], "seed": 0}
    if request.folder is None:
        images |= {key: max(500, round(base["images"][key] * cut.fraction)) for key in ("train", "test")}
    else:
        images |= {"folder": str(request.folder), **_counts(request.folder, images["minival"], cut.fraction)}
    keys = {
        "format": base["format"],
        "name": request.name,
        "seeds": list(range(request.seeds)),
        "tables": list(cut.tables),
        "images": images,
        "spec": base["spec"] | {"f_number": request.f_number, "field_of_view_deg": request.field_of_view_deg},
        "elements": {name: list(plastics) for name, plastics in request.elements.items()},
        "supervisor": networks[0],
        "classifiers": {
            name: _network(base["classifiers"], request, network)
            for name, network in zip(networks, request.networks, strict=True)
        },
        "designs": designs,
        "fine_tuning": base["fine_tuning"],
        "restoration": base["restoration"],
    }
    parse(keys)  # raises StudyError
    return keys


def _base(size: int) -> dict[str, Any]:
    """Return the default study; for large images, with the steps of the studies of photographs."""
    base = dict(default_study())
    for name, keys in _OF_LARGE_IMAGES.items() if size >= LARGE else ():
        layer = with_named_designs(yaml.safe_load((ROOT / "config" / name).read_text(encoding="utf-8")))
        base |= {key: merged_settings(base[key], layer[key]) for key in keys}
    return base


def _design(designs: Mapping[str, Any], name: str, cut: Cut) -> dict[str, Any]:
    """Return a design of the default study: it starts only from designs of the cut, with a fraction of the steps."""
    designs_in_cut = cut.designs or tuple(designs)
    design = dict(designs[name])
    if isinstance(design.get("start"), list):
        design["start"] = [other for other in design["start"] if other in designs_in_cut]
    if "descents" in design and cut.fraction < 1:
        parts = design["descents"]
        design["descents"] = [part | {"steps": max(1, round(part["steps"] * cut.fraction))} for part in parts]
    if design.get("method") == "least_squares" and cut.fraction < 1:
        design["evaluations"] = round(LeastSquaresSettings.model_fields["evaluations"].default * cut.fraction)
    return design


def _network(networks: Mapping[str, Any], request: StudyRequest, name: str) -> dict[str, Any]:
    """Return the section of a network: from the default study, or from timm with weights and a new head."""
    if name not in networks:
        if request.weights is None or name != request.networks[0]:
            return {"model": name, "pretrained": True, "training": {"epochs": 1, "learning_rate": 3e-4}}
        options = {"outputs": request.outputs, "arguments": dict(request.arguments)}
        return {"model": name, "weights": str(request.weights), **options}  # as it is, without further training
    network = dict(networks[name])
    if "img_size" in network.get("arguments", {}):
        network["arguments"] = network["arguments"] | {"img_size": request.size}
    return network


def fit(request: StudyRequest, minutes: float, cores: int) -> tuple[Cut, float]:
    """Return the largest cut of the default study that takes at most `minutes` on some cores, and its duration [s].

    The duration is that of `tasklens study plan`, times the fraction of its steps and images; 0 if no study like it was
    measured, which every time fits.

    Raises:
        InputError: not even the smallest cut fits.
    """

    @cache
    def seconds(cut: Cut) -> float:
        with TemporaryDirectory() as place:
            path = Path(place, "study.yaml")
            write_text(path, text(request, cut, "a trial", cores, path))
            study = load(path)
            plan = planning.plan([path], "tables").get(study.name, {})
        rules = [rule for rule, jobs in plan.items() for _ in (*jobs.done, *jobs.missing, *jobs.rerun)]
        return cut.fraction * durations_of(study).total(rules)[0] / cores

    largest = bisect_left(CUTS, -60 * minutes, key=lambda cut: -seconds(cut))  # each is smaller than the one before
    cut = CUTS[min(largest, len(CUTS) - 1)]
    if seconds(cut) > 60 * minutes:
        raise InputError(
            f"--minutes {minutes:g}: the smallest study of this kind takes about {duration(seconds(cut))} on {cores} "
            "cores; allow more time, or choose fewer elements, networks or seeds"
        )
    return cut, seconds(cut)


def check(request: StudyRequest) -> None:
    """Check the folder of images, and that timm has all networks that are not in the default study.

    Raises:
        InputError: an input cannot be used; the message names it.
    """
    study = parse(content(request, CUTS[0]))
    class_folders.check(study.images)
    defaults = default_study()["classifiers"]
    if request.weights is not None and request.networks[0] in defaults:
        raise InputError(f"--weights: only for a network from timm; {request.networks[0]} is trained on the images")
    if others := [name for name in request.networks if name not in defaults]:
        from tasklens.recognition import classifiers

        classes = RENDERED_CLASSES if request.folder is None else len(class_folders.training_classes(request.folder))
        for name, settings in study.classifiers.items():
            if settings.model in others:
                classifiers.check(name, settings, request.size, classes)


_COMMENTS = {
    "name": "results are in results/<name>",
    "seeds": "each job runs once per seed; five or more seeds give verdicts, fewer give suggestions",
    "tables": (
        "1: task-driven compared with imaging lenses; 2: other networks; 3: end-to-end design; 4: with restoration"
    ),
    "images": "photographs in train/<class>/* and test/<class>/* (or val) of `folder`; without it, rendered images",
    "spec": "specification of all lenses; lengths in mm unless a key says otherwise",
    "elements": "plastics from front to back; tasklens/materials/plastics.yaml has the built-in ones",
    "supervisor": "supervises the task-driven designs, and measures lenses in tables 1, 3 and 4",
    "classifiers": "networks, by their names in timm",
    "designs": "config/config.yaml explains each of them",
    "fine_tuning": "fine-tuning of every classifier on every lens",
    "restoration": "the restoration network of table 4",
}


def text(request: StudyRequest, cut: Cut, forecast: str, cores: int, path: Path) -> str:
    """Return the text of the study file: description, forecast, command, and keys with comments."""
    lines = [
        f"# {cut.words[0].upper()}{cut.words[1:]}, {forecast}.",
        "# All keys: `tasklens study schema`, or the reference page in docs.",
        "#",
        f"#   snakemake -j{cores} tables --configfile {path}",
    ]
    for key, value in content(request, cut).items():
        if key in _COMMENTS:
            lines.append(f"\n# {_COMMENTS[key]}")
        lines += _yaml(key, value)
    return "\n".join(lines) + "\n"


def _yaml(key: str, value: Any, indent: str = "") -> list[str]:
    """Return a key as lines of YAML; a short mapping that contains no other mapping takes one line."""
    line = f"{indent}{key}: {in_one_line(value)}"
    is_nested = isinstance(value, Mapping) and any(isinstance(item, Mapping) for item in value.values())
    if not isinstance(value, Mapping) or (len(line) <= _WIDTH and not is_nested):
        return [line]
    return [f"{indent}{key}:", *(line for k, v in value.items() for line in _yaml(k, v, f"{indent}  "))]
