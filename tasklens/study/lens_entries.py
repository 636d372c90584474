"""Entries of a study's lenses: designed, or imported from files; no torch here."""

from pathlib import Path
from typing import Any

from pydantic import Field, FilePath, field_validator

from tasklens.materials.material import Material
from tasklens.study.design_settings import (
    DesignSettings,
    EndToEndSettings,
    JointRaySpaceSettings,
    SupervisedSettings,
    TaskDrivenSettings,
)
from tasklens.study.quantities import Name
from tasklens.study.settings import CaptureSettings, ClassifierSettings, Constraints, Frozen, Spec
from tasklens.study.task_settings import TaskSettings


class ImportedLens(Frozen):
    """A lens from a file, scaled and refocused to the specification; its materials are those of the file."""

    elements: Name = Field(description="Name of its elements in the tables.")
    file: FilePath = Field(description="A Zemax file (.zmx), or a lens.yaml.")
    catalogues: tuple[FilePath, ...] = Field((), description="Glass catalogues of the file (.agf or YAML).")

    @property
    def sources(self) -> tuple[Path, ...]:
        """The file and its catalogues."""
        return self.file, *self.catalogues

    @field_validator("file")
    @classmethod
    def _known_kind(cls, file: Path) -> Path:
        if file.suffix.lower() not in (".zmx", ".yaml", ".yml"):
            raise ValueError("expected a lens file, .zmx or .yaml")
        return file


class LensEntry(Frozen):
    """Description of one lens of the study: its elements, and its design or the file that it is imported from."""

    name: str = Field(description="`{elements}-{design_name}`.")
    elements: str = Field(description="Name of its elements.")
    plastics: tuple[Material, ...] = Field(description="Materials with coefficients: editing one redesigns its lenses.")
    design_name: str = Field(description="Name of its design.")
    design: DesignSettings | ImportedLens = Field(description="Design method, or file.")
    capture: CaptureSettings | None = Field(None, description="Changed capture of an ablation; null: the study's.")

    @property
    def classified(self) -> bool:
        """True if a network supervises the design: a classifier, or that of another task."""
        return isinstance(self.design, TaskDrivenSettings | EndToEndSettings | JointRaySpaceSettings)

    @property
    def task_driven(self) -> bool:
        """True if the design is by a classifier, frozen or trained jointly, but not end-to-end as in the paper."""
        design = self.design
        return (isinstance(design, TaskDrivenSettings) and design.task is None) or (
            isinstance(design, JointRaySpaceSettings) and bool(design.candidates)
        )

    @property
    def other_task(self) -> str | None:
        """Name of the task beside classification that the lens is designed for."""
        return self.design.task if isinstance(self.design, TaskDrivenSettings) else None

    @property
    def supervised(self) -> bool:
        """True if the design sees images."""
        return self.classified or isinstance(self.design, SupervisedSettings)

    @property
    def resized(self) -> dict[str, Any]:
        """The descents of the design for which images are resized, by the key of that size."""
        design = self.design
        parts: dict[str, Any] = {"size": design, "polish.size": getattr(design, "polish", None)}
        if isinstance(design, SupervisedSettings):
            parts |= {f"{name}.size": descent for name, descent in design.descents.items()}
        return {key: part for key, part in parts.items() if getattr(part, "size", None) is not None}

    @property
    def constrained(self) -> bool:
        """True if the lens has to keep the constraints and the focal length, which verification checks.

        End-to-end designs from flat, which need not converge, and imported lenses are not.
        """
        design = self.design
        if isinstance(design, EndToEndSettings):
            return design.start != "flat"
        return bool(self.task_driven or self.other_task) or not (self.classified or isinstance(design, ImportedLens))


class LensDesign(Frozen):
    """The slice of a study that the design of one lens may read.

    Attributes:
        entry: the lens, its plastics and its method.
        spec, constraints: specification and limits.
        capture, classifier: for designs supervised by a classifier.
        task, network: name and settings of another task, for designs supervised by its network.
        rays: rays per field and colour for the figures.
        seed: seed of all random numbers.
    """

    entry: LensEntry
    spec: Spec
    constraints: Constraints
    capture: CaptureSettings | None
    classifier: ClassifierSettings | None
    task: str | None
    network: TaskSettings | None
    rays: int
    seed: int
