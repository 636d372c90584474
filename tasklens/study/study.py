"""The configuration of a study, validated before the first job; no torch here."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import Field, TypeAdapter, ValidationInfo, field_serializer, field_validator

from tasklens.materials.library import Library
from tasklens.materials.material import Material, from_definitions
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.settings.base import Frozen, Name, Rays, Seed, StudyName
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DesignSettings, LeastSquaresSettings
from tasklens.settings.field_settings import FieldSet, FieldSettings, Points, points
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.layers import merged_settings
from tasklens.settings.lens_entries import ImportedLens, LensEntry
from tasklens.settings.messages import validate
from tasklens.settings.network_settings import ClassifierSettings, RestorationSettings, TrainingSettings
from tasklens.settings.specification import Constraints, Spec
from tasklens.settings.task_settings import TaskSettings, TasksSettings
from tasklens.settings.tolerance_settings import ToleranceSettings
from tasklens.study.sweep import Sweep

TableName = Literal["table1", "table2", "table3", "table4"]
TABLES: tuple[TableName, ...] = get_args(TableName)
_DESIGN: TypeAdapter[DesignSettings] = TypeAdapter(DesignSettings)


class StudyError(InputError):
    """A study file that cannot be run; the message names the key, the value and what was expected."""


class RankingSettings(Frozen):
    """Facts of the lenses of a study that `tasklens rank` adds to their files."""

    titles: dict[str, str] = Field({}, description="Display names of lenses, by lens.")
    left_out: dict[str, str] = Field({}, description="Lenses that are not measured, with the reason.")
    mtf: dict[str, float] = Field({}, description="Mean MTF of lenses, by which the sieve chose them.")
    built: tuple[str, ...] = Field((), description="Lenses to build in simulation.")


class Ablation(Frozen):
    """Variants of one design of one set of elements.

    Attributes:
        elements, design: names of the elements and of the design.
        variants: by name, the keys of the design that differ; `capture` holds keys of the study's capture that differ
            both in the design and in the measurement of the variant, and `fields` the fields of its losses.
    """

    elements: Name
    design: Name
    variants: Annotated[dict[Name, dict[str, Any]], Field(min_length=1)]

    def name(self, ablation: str, variant: str) -> str:
        """Return the design name of a variant."""
        return f"{self.design}_{ablation}_{variant}"


class Study(Frozen):
    """The configuration of a study; `loading.parse` also checks that its sections are consistent.

    Its lenses are all combinations of `elements` and `designs`, and those of `imported`. `materials` is given as a list
    of files (YAML or AGF) or as definitions; only the definitions of the plastics in `elements` are stored, so that a
    resolved study needs no other file.
    """

    format: Literal[3] = Field(description="Version of the keys of a study file.")
    name: StudyName = Field(description="Name of the study; results are in results/<name>.")
    seeds: tuple[Seed, ...] = Field(
        (0,), min_length=1, max_length=1000, description="Seeds of design, fine-tuning and data order."
    )
    images: ImageSettings = Field(description="The labelled images.")
    spec: Spec = Field(Spec(), description="Specification of all lenses.")
    specs: dict[Name, dict[str, Any]] = Field(
        default_factory=dict, description="Changed keys of `spec`, by name of elements."
    )
    constraints: Constraints = Field(Constraints(), description="Limits of every design.")
    capture: CaptureSettings = Field(CaptureSettings(), description="Settings of captures.")
    fields: FieldSettings = Field(
        FieldSettings(), description="Fields that designs see and lenses are graded at; paper: its nine for both."
    )
    evaluation_rays: Rays = Field(4096, description="Rays per field and colour of cached PSFs and of figures.")
    elements: dict[Name, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(
        description="Plastics from front to back, by name."
    )
    materials: dict[str, Material] = Field(
        default_factory=dict, validate_default=True, description="Files of further plastics (.yaml, .agf)."
    )
    designs: dict[Name, DesignSettings] = Field(description="Design methods by name.")
    imported: dict[Name, ImportedLens] = Field(default_factory=dict, description="Lenses from files, by name.")
    ablations: dict[Name, Ablation] = Field(default_factory=dict, description="Ablations by name.")
    classifiers: dict[Name, ClassifierSettings] = Field(min_length=1, description="Networks by name.")
    tables: tuple[TableName, ...] = Field(
        TABLES, min_length=1, description="Tables to make, to test claims on, and to verify."
    )
    supervisor: Name = Field(
        description="The classifier that supervises designs, and measures lenses in tables 1, 3 and 4."
    )
    fine_tuning: TrainingSettings = Field(description="Fine-tuning of classifiers on lenses, and on the sharp images.")
    restoration: RestorationSettings = Field(description="The restoration network of table 4.")
    restored: tuple[Name, ...] | None = Field(None, description="Elements in table 4; null: all.")
    tolerances: ToleranceSettings = Field(
        ToleranceSettings(), description="Lenses built in simulation, with manufacturing errors."
    )
    tasks: TasksSettings = Field(
        TasksSettings(), description="Tasks other than classification: segmentation and detection of objects."
    )
    ranking: RankingSettings = Field(RankingSettings(), description="The ranking of lenses by `tasklens rank`.")
    sweep: Sweep = Field(
        {},
        description="Values of keys such as `spec.f_number`; each combination is a study of its own, below "
        "results/<name>.",
    )

    @field_validator("seeds", "tables")
    @classmethod
    def _distinct(cls, values: tuple) -> tuple:
        if len(set(values)) < len(values):
            raise ValueError("expected no duplicates")
        return values

    @field_validator("materials", mode="before")
    @classmethod
    def _used(cls, value: object, info: ValidationInfo) -> dict[str, Material]:
        definitions: Mapping[str, Material] = {}
        library = Library()
        if isinstance(value, Mapping):
            definitions = from_definitions(value, "definitions")
        elif isinstance(value, list) and all(isinstance(path, str) for path in value):
            library = Library([Path(path) for path in value])
            library.check()
        else:
            raise ValueError("expected a list of files, or definitions by name")
        plastics = {}
        for name, materials in info.data.get("elements", {}).items():
            for material in materials:
                try:
                    plastics[material] = definitions[material] if material in definitions else library.glass(material)
                except FileError as error:
                    raise ValueError(f"elements.{name}: {error}") from None
        return plastics

    @field_serializer("materials")
    def _defined(self, materials: dict[str, Material]) -> dict:
        return {name: material.definition() for name, material in materials.items()}

    def variant(self, name: str, variant: str) -> LensEntry:
        """Return the lens of a variant of the ablation `name`.

        Raises:
            ValueError: invalid changes (pydantic's ValidationError), a `capture` that is no mapping, or a sensor
                without a choice of `colour`.
        """
        ablation, where = self.ablations[name], f"ablations.{name}.variants.{variant}.capture"
        changes = dict(ablation.variants[variant])
        other, fields = changes.pop("capture", None), changes.pop("fields", None)
        if not isinstance(other, dict | None):
            raise ValueError(f"{where}: expected keys and values, got {other!r}")
        if other is not None:
            self.capture.check_new_sensor(other, where)
        design = _DESIGN.validate_python(merged_settings(self.designs[ablation.design].model_dump(), changes))
        capture = None
        if other is not None:
            capture = CaptureSettings.model_validate(merged_settings(self.capture.model_dump(), other))
        return self._entry(ablation.elements, ablation.name(name, variant), design, capture, fields)

    def spec_of(self, elements: str) -> Spec:
        """Return the specification of some elements: `spec` changed by their entry in `specs`; raises ValueError."""
        return _change(self.spec, self.specs.get(elements, {}), f"specs.{elements}")

    def lens_spec(self, lens: str) -> Spec:
        """Return the specification of a lens: that of its elements, changed by the `spec` of an imported lens."""
        entry = self.lens(lens)
        spec = self.spec_of(entry.elements)
        if not isinstance(entry.design, ImportedLens):
            return spec
        return _change(spec, entry.design.spec, f"imported.{entry.design_name}.spec")

    def capture_of(self, lens: str) -> CaptureSettings:
        """Return the capture settings of a lens: `capture`, unless an ablation changes it; raises StudyError."""
        return self.lens(lens).capture or self.capture

    def design_points(self, lens: str) -> Points | None:
        """Return the fields of the losses of a design, unless an ablation changes them.

        None: they are drawn, or the lens has no descents.
        """
        entry = self.lens(lens)
        return points(entry.fields or self.fields.design) if entry.design.descents else None

    @property
    def lenses(self) -> dict[str, LensEntry]:
        """All lenses by name, `{elements}-{design}`; imported lenses last."""
        entries = [self._design(elements, name) for elements in self.elements for name in self.designs]
        return {lens.name: lens for lens in entries} | {
            f"{lens.elements}-{name}": LensEntry(
                name=f"{lens.elements}-{name}", elements=lens.elements, plastics=(), design_name=name, design=lens
            )
            for name, lens in self.imported.items()
        }

    def _design(self, elements: str, name: str) -> LensEntry:
        return self._entry(elements, name, self.designs[name])

    def _entry(
        self,
        elements: str,
        name: str,
        design: DesignSettings,
        capture: CaptureSettings | None = None,
        fields: FieldSet | None = None,
    ) -> LensEntry:
        return LensEntry(
            name=f"{elements}-{name}",
            elements=elements,
            plastics=tuple(self.materials[plastic] for plastic in self.elements[elements]),
            design_name=name,
            design=design.of_elements(elements) if isinstance(design, LeastSquaresSettings) else design,
            capture=capture,
            fields=fields,
        )

    @property
    def variants(self) -> dict[str, LensEntry]:
        """Lenses of the variants of all ablations, by name."""
        entries = [self.variant(name, variant) for name, item in self.ablations.items() for variant in item.variants]
        return {lens.name: lens for lens in entries}

    def lens(self, name: str) -> LensEntry:
        """Return the lens `name`; raises StudyError with the known names."""
        elements, _, design = name.partition("-")
        if elements in self.elements and design in self.designs:
            return self._design(
                elements, design
            )  # builds no other lens: planning calls this tens of thousands of times
        return pick(self.lenses | self.variants, name, "lens")

    def classifier(self, name: str) -> ClassifierSettings:
        """Return the classifier `name`; raises StudyError with the known names."""
        return pick(self.classifiers, name, "classifier")

    def task(self, name: str) -> TaskSettings:
        """Return the task `name`; raises StudyError with the known names."""
        return pick(self.tasks.networks, name, "task")

    def task_network(self, name: str) -> TaskSettings:
        """Return the task `name` for use without fine-tuning on captures."""
        task = self.task(name)
        return task.model_copy(update={"fine_tuning": task.training})


_Entry = TypeVar("_Entry")


def pick(entries: Mapping[str, _Entry], name: str, kind: str) -> _Entry:
    """Return the entry `name` of `entries`; raises StudyError with the known names."""
    if name not in entries:
        raise StudyError(f"unknown {kind} {name!r}; expected one of {', '.join(entries)}")
    return entries[name]


def _change(spec: Spec, changes: Mapping[str, Any], where: str) -> Spec:
    """Return a specification with changed keys, which the user's file has at `where`; raises InputError."""
    return validate(Spec, spec.model_dump(exclude_computed_fields=True) | dict(changes), where)
