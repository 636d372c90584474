"""The whole configuration of a study, checked before the first job; no torch here.

A study file is YAML. An unknown key or an impossible value raises `StudyError` with the key, the value and what
was expected.
"""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_serializer, field_validator, model_validator

from tasklens.design_settings import Design, EndToEnd, LeastSquares, Lens, Outside, Spot
from tasklens.optics.catalogues import collect
from tasklens.optics.materials import Material, from_definitions
from tasklens.settings import (
    FLAT_TRACK,
    Capture,
    Classifier,
    Constraints,
    Count,
    Frozen,
    Images,
    Name,
    Restoration,
    Spec,
    Training,
)

STAGES = (
    "images",
    "reference",
    "design",
    "psf",
    "tail",
    "fine_tune",
    "restore",
    "fine_tune_restored",
    "reproduce",
    "reproduce_restored",
    "table",
    "psf_tail",
    "verdicts",
    "regimes",
    "figure",
)


class StudyError(ValueError):
    """A study file that cannot be run; the message names the key, the value and what was expected."""


class Study(Frozen):
    """Everything a study is made of. `lenses` = every entry of `elements` with every one of `designs`, and `outside`.

    `materials` is given as a list of files (YAML or AGF) or as definitions; it becomes the definitions of the plastics
    that `elements` use, so that a resolved study needs no other file.
    """

    format: Literal[1]
    name: Name
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)
    images: Images
    spec: Spec = Spec()
    specs: Annotated[dict[Name, dict[str, Any]], Field(default_factory=dict)]  # by elements: what differs from `spec`
    constraints: Constraints = Constraints()
    capture: Capture = Capture()
    evaluation_rays: Count = 4096
    elements: Annotated[dict[Name, tuple[str, ...]], Field(min_length=1)]
    materials: Annotated[dict[str, Material], Field(default_factory=dict, validate_default=True)]
    designs: Annotated[dict[Name, Design], Field(min_length=1)]
    outside: Annotated[dict[Name, Outside], Field(default_factory=dict)]
    classifiers: Annotated[dict[Name, Classifier], Field(min_length=1)]
    supervisor: Name  # the classifier that supervises the task-driven designs, and judges all lenses in tables 1, 3, 4
    fine_tuning: Training
    restoration: Restoration
    minutes: dict[Literal[STAGES], Annotated[float, Field(ge=0)]]  # measured per job of a stage: the forecast

    @field_validator("seeds")
    @classmethod
    def _distinct(cls, seeds: tuple) -> tuple:
        if len(set(seeds)) < len(seeds):
            raise ValueError("expected every seed once")
        return seeds

    @field_validator("elements")
    @classmethod
    def _not_empty(cls, elements: dict) -> dict:
        for name, plastics in elements.items():
            if not plastics:
                raise ValueError(f"{name}: expected at least one plastic")
        return elements

    @field_validator("materials", mode="before")
    @classmethod
    def _used(cls, given: object, info: ValidationInfo) -> dict[str, Material]:
        if isinstance(given, Mapping):
            known = collect([]) | from_definitions(given, "definitions")
        elif isinstance(given, list) and all(isinstance(path, str) for path in given):
            try:
                known = collect(Path(path) for path in given)
            except OSError as error:
                raise ValueError(f"{error.filename}: cannot be read: {error.strerror}") from None
        else:
            raise ValueError("expected a list of files, or definitions by name")
        used = {}
        for name, plastics in info.data.get("elements", {}).items():
            for plastic in plastics:
                if plastic not in known:
                    nearest = ", ".join(difflib.get_close_matches(plastic, known, 8, 0))
                    raise ValueError(
                        f"elements.{name}: unknown plastic {plastic!r}; known ones nearest to it: {nearest}"
                    )
                used[plastic] = known[plastic]
        return used

    @field_serializer("materials")
    def _defined(self, materials: dict[str, Material]) -> dict:
        return {name: material.definition() for name, material in materials.items()}

    @model_validator(mode="after")
    def _consistent(self):
        if self.supervisor not in self.classifiers:
            raise ValueError(f"supervisor: {self.supervisor!r} is not one of {', '.join(self.classifiers)}")
        for name, design in self.designs.items():
            if isinstance(design, EndToEnd) and design.start == "best_imaging" and not self.imaging_designs:
                raise ValueError(f"designs.{name}.start: 'best_imaging' needs a design by spot or least_squares")
        for name in self.outside:
            if name in self.designs:
                raise ValueError(f"outside.{name}: one of the designs is called {name} too; rename one")
        known = dict.fromkeys([*self.elements, *(lens.elements for lens in self.outside.values())])
        for name in self.specs:
            if name not in known:
                raise ValueError(f"specs.{name}: expected elements of the study, one of {', '.join(known)}")
        for name, plastics in self.elements.items():
            self._fits(name, plastics, self.spec_of(name))
        if self.images.size % self.restoration.multiple:
            raise ValueError(
                f"images.size: {self.images.size} is not a multiple of {self.restoration.multiple}, which the "
                f"restoration network of {len(self.restoration.encoder)} levels needs"
            )
        return self

    def _fits(self, name: str, plastics: tuple[str, ...], spec: Spec) -> None:
        """Whether the plastics, the kernel and the track suit a specification: plates must fit into a flat start."""
        for material in (self.materials[plastic] for plastic in plastics):
            for wavelength in spec.wavelengths_um:
                if not material.covers(wavelength):
                    low, high = material.range_um
                    raise ValueError(
                        f"spec.wavelengths_um: {wavelength} um is outside the {low} to {high} um in which the "
                        f"coefficients of {material.name} hold"
                    )
        if spec.kernel // 2 >= self.images.size:
            raise ValueError(
                f"spec.kernel: half of {spec.kernel} must be less than images.size = {self.images.size}, "
                "since borders are reflected"
            )
        limits, elements = self.constraints, len(plastics)
        if limits.min_centre_thickness >= limits.max_centre_thickness:
            raise ValueError(
                f"constraints.min_centre_thickness: {limits.min_centre_thickness} mm must be less than "
                f"max_centre_thickness = {limits.max_centre_thickness} mm"
            )
        least = limits.stop_distance + limits.min_back_focus
        least += elements * limits.min_centre_thickness + (elements - 1) * limits.min_air_gap
        available = min(limits.max_track, FLAT_TRACK * spec.efl_mm)
        if least >= available:
            raise ValueError(
                f"constraints: a {name} takes at least {least:.2f} mm from stop to image, more than the "
                f"{available:.2f} mm of max_track = {limits.max_track} and of {FLAT_TRACK} focal lengths; a flat start "
                "would have a negative thickness"
            )

    def spec_of(self, elements: str) -> Spec:
        """The specification of these elements: `spec` with what `specs` says of them."""
        common = self.spec.model_dump(exclude=set(Spec.model_computed_fields))
        try:
            return Spec.model_validate(common | self.specs.get(elements, {}))
        except ValidationError as error:
            wrong = "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
            raise ValueError(f"specs.{elements}.{wrong}") from None

    @property
    def lenses(self) -> dict[str, Lens]:
        """Every lens by name, `{elements}-{design}`; those from outside last."""
        designed = {
            f"{elements}-{name}": Lens(
                name=f"{elements}-{name}",
                elements=elements,
                plastics=tuple(self.materials[plastic] for plastic in plastics),
                design_name=name,
                design=design,
            )
            for elements, plastics in self.elements.items()
            for name, design in self.designs.items()
        }
        return designed | {
            f"{lens.elements}-{name}": Lens(
                name=f"{lens.elements}-{name}", elements=lens.elements, plastics=(), design_name=name, design=lens
            )
            for name, lens in self.outside.items()
        }

    @property
    def imaging_designs(self) -> tuple[str, ...]:
        """Names of the designs that image quality alone supervises."""
        return tuple(name for name, design in self.designs.items() if isinstance(design, Spot | LeastSquares))

    def lens(self, name: str) -> Lens:
        """The lens `name`; raises StudyError with the known names."""
        return _pick(self.lenses, name, "lens")

    def classifier(self, name: str) -> Classifier:
        """The classifier `name`; raises StudyError with the known names."""
        return _pick(self.classifiers, name, "classifier")


def _pick(known: Mapping, name: str, kind: str):
    if name not in known:
        raise StudyError(f"unknown {kind} {name!r}; expected one of {', '.join(known)}")
    return known[name]


def parse(config: Mapping) -> Study:
    """The study that a mapping describes.

    Raises:
        StudyError: naming every wrong key with its value and what was expected.
    """
    try:
        return Study.model_validate(dict(config))
    except ValidationError as error:
        lines = []
        for item in error.errors():
            key = ".".join(str(part) for part in item["loc"]) or "study"
            value = item["input"]
            shown = f" = {value!r}" if not isinstance(value, dict) else ""
            lines.append(f"  {key}{shown}: {item['msg'].removeprefix('Value error, ')}")
        raise StudyError("the study cannot be run:\n" + "\n".join(lines)) from None


def load(path: str | Path) -> Study:
    """The study in a YAML file; raises StudyError as `parse` does, and where the file is no YAML mapping."""
    try:
        with open(path) as file:
            content = yaml.safe_load(file)
    except yaml.YAMLError as error:
        raise StudyError(f"{path}: not valid YAML: {error}") from None
    if not isinstance(content, Mapping):
        raise StudyError(f"{path}: expected keys and values, found {type(content).__name__}")
    return parse(content)


def dump(study: Study) -> str:
    """The resolved study as YAML, every default written out."""
    computed = {"spec": set(Spec.model_computed_fields)}
    return yaml.safe_dump(study.model_dump(mode="json", exclude=computed), sort_keys=False)
