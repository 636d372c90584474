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

from tasklens.materials.catalogues import collect
from tasklens.materials.material import Material, from_definitions
from tasklens.study import feasibility
from tasklens.study.ablations import Ablation, varied
from tasklens.study.design_settings import Design, EndToEnd, LeastSquares, Lens, Outside, Spot
from tasklens.study.settings import (
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
    "certificate",
    "fine_tune",
    "restore",
    "fine_tune_restored",
    "reproduce",
    "reproduce_restored",
    "table",
    "psf_tail",
    "verdicts",
    "regimes",
    "ablation",
    "figure",
    "comparison",
)


TABLES = ("table1", "table2", "table3", "table4")


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
    ablations: Annotated[dict[Name, Ablation], Field(default_factory=dict)]
    classifiers: Annotated[dict[Name, Classifier], Field(min_length=1)]
    tables: Annotated[tuple[Literal[TABLES], ...], Field(min_length=1)] = TABLES  # made, judged and verified together
    supervisor: Name  # the classifier that supervises the task-driven designs, and judges all lenses in tables 1, 3, 4
    fine_tuning: Training
    restoration: Restoration
    restored: tuple[Name, ...] | None = None  # elements whose captures are restored, table 4; null means all
    minutes: dict[Literal[STAGES], Annotated[float, Field(ge=0)]]  # measured per job of a stage: the forecast

    @field_validator("seeds", "tables")
    @classmethod
    def _distinct(cls, given: tuple) -> tuple:
        if len(set(given)) < len(given):
            raise ValueError("expected each once")
        return given

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
        for name, classifier in self.classifiers.items():
            if self.fine_tuning.batch % classifier.processes:
                raise ValueError(
                    f"classifiers.{name}.processes: {classifier.processes} processes cannot share "
                    f"fine_tuning.batch = {self.fine_tuning.batch} equally"
                )
        for name in self.outside:
            if name in self.designs:
                raise ValueError(f"outside.{name}: one of the designs is called {name} too; rename one")
        known = dict.fromkeys([*self.elements, *(lens.elements for lens in self.outside.values())])
        for name in self.specs:
            if name not in known:
                raise ValueError(f"specs.{name}: expected elements of the study, one of {', '.join(known)}")
        for name in self.restored or ():
            if name not in known:
                raise ValueError(f"restored: {name!r} is not one of {', '.join(known)}")
        for name, plastics in self.elements.items():
            materials = tuple(self.materials[plastic] for plastic in plastics)
            feasibility.check(name, materials, self.spec_of(name), self.constraints, self.images.size)
        for name in self.ablations:
            self._check_ablation(name)
        for lens in (self.lenses | self.variants).values():
            kernel = self.spec_of(lens.elements).kernel
            for part in (lens.design, getattr(lens.design, "polish", None)):
                size = getattr(part, "size", None)
                if size is not None and not kernel // 2 < size <= self.images.size:
                    raise ValueError(
                        f"designs.{lens.design_name}: size: expected more than half of spec.kernel = {kernel} and at "
                        f"most images.size = {self.images.size}, got {size}"
                    )
            starts = lens.design.start if isinstance(lens.design, EndToEnd) else None
            if starts == "best_imaging" and not self.imaging_designs:
                raise ValueError(
                    f"designs.{lens.design_name}.start: 'best_imaging' needs a design by spot or least_squares"
                )
        if self.images.size % self.restoration.multiple:
            raise ValueError(
                f"images.size: {self.images.size} is not a multiple of {self.restoration.multiple}, which the "
                f"restoration network of {len(self.restoration.encoder)} levels needs"
            )
        return self

    def _check_ablation(self, name: str) -> None:
        ablation = self.ablations[name]
        for key, known in (("elements", self.elements), ("design", self.designs)):
            if getattr(ablation, key) not in known:
                raise ValueError(f"ablations.{name}.{key}: {getattr(ablation, key)!r} is not one of {', '.join(known)}")
        for variant in ablation.variants:
            try:
                lens = self._variant(name, variant)
            except ValidationError as error:
                raise ValueError(f"ablations.{name}.variants.{variant}.{_problems(error)}") from None
            named = [*self.designs, *self.outside]
            named += [item.name(key, other) for key, item in self.ablations.items() for other in item.variants]
            if named.count(lens.design_name) > 1:
                raise ValueError(f"ablations.{name}: {lens.design_name} is the name of another design too; rename one")

    def _variant(self, name: str, variant: str) -> Lens:
        ablation = self.ablations[name]
        return varied(self._designed(ablation.elements, ablation.design), self.capture, name, ablation, variant)

    def spec_of(self, elements: str) -> Spec:
        """The specification of these elements: `spec` with what `specs` says of them."""
        common = self.spec.model_dump(exclude=set(Spec.model_computed_fields))
        try:
            return Spec.model_validate(common | self.specs.get(elements, {}))
        except ValidationError as error:
            raise ValueError(f"specs.{elements}.{_problems(error)}") from None

    def capture_of(self, lens: str) -> Capture:
        """How pictures become captures of this lens: as in `capture`, unless an ablation changes it."""
        return self.lens(lens).capture or self.capture

    @property
    def lenses(self) -> dict[str, Lens]:
        """Every lens by name, `{elements}-{design}`; those from outside last."""
        designed = [self._designed(elements, name) for elements in self.elements for name in self.designs]
        return {lens.name: lens for lens in designed} | {
            f"{lens.elements}-{name}": Lens(
                name=f"{lens.elements}-{name}", elements=lens.elements, plastics=(), design_name=name, design=lens
            )
            for name, lens in self.outside.items()
        }

    def _designed(self, elements: str, design: str) -> Lens:
        return Lens(
            name=f"{elements}-{design}",
            elements=elements,
            plastics=tuple(self.materials[plastic] for plastic in self.elements[elements]),
            design_name=design,
            design=self.designs[design],
        )

    @property
    def variants(self) -> dict[str, Lens]:
        """Every lens by name that only an ablation asks for."""
        found = [self._variant(name, variant) for name, item in self.ablations.items() for variant in item.variants]
        return {lens.name: lens for lens in found}

    @property
    def imaging_designs(self) -> tuple[str, ...]:
        """Names of the designs that image quality alone supervises."""
        return tuple(name for name, design in self.designs.items() if isinstance(design, Spot | LeastSquares))

    def lens(self, name: str) -> Lens:
        """The lens `name`; raises StudyError with the known names."""
        return pick(self.lenses | self.variants, name, "lens")

    def classifier(self, name: str) -> Classifier:
        """The classifier `name`; raises StudyError with the known names."""
        return pick(self.classifiers, name, "classifier")


def _problems(error: ValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())


def pick(known: Mapping, name: str, kind: str):
    """The entry `name` of `known`; raises StudyError with the known names."""
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
