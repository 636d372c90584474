"""Entries of a study's lenses: designed, or imported from files; no torch here."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, FilePath, field_validator

from tasklens.materials.catalogues import MAKERS, PLASTICS, catalogues_in_folder
from tasklens.materials.material import Material
from tasklens.settings.base import Frozen, Name, WithoutDescents
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DesignSettings
from tasklens.settings.field_settings import FieldSet, Points
from tasklens.settings.names import Focus
from tasklens.settings.network_settings import ClassifierSettings
from tasklens.settings.specification import Constraints, Spec
from tasklens.settings.task_settings import TaskSettings

_WORKFLOW = Path(__file__).parents[2]


def _here_or_shipped(path: Any) -> Any:
    """Return a path, or the same path in the folder of the workflow if there is no such file here."""
    shipped = _WORKFLOW / path if isinstance(path, str | Path) else None
    return shipped if shipped and shipped.is_file() and not Path(path).exists() else path


LensFile = Annotated[FilePath, BeforeValidator(_here_or_shipped)]


class ImportedLens(WithoutDescents):
    """A lens from a file, scaled to the specification; its materials are those of the file."""

    elements: Name = Field(description="Name of its elements in the tables.")
    file: LensFile = Field(description="A Zemax file (.zmx), or a lens.yaml.")
    catalogues: tuple[LensFile, ...] = Field((), description="Glass catalogues of the file (.agf or YAML).")
    spec: dict[str, Any] = Field({}, description="Keys of `spec` that differ for this lens.")
    focus: Focus | None = Field(
        None,
        description="Image plane. file: as in the file, scaled with the lens; network: least loss of the supervisor on "
        "training images; mtf: peak of the MTF; spot: smallest RMS spot; null: as in the file if size and object "
        "distance are those of the file, else by the network.",
    )

    @property
    def sources(self) -> tuple[Path, ...]:
        """The file, and its catalogues: for a Zemax file also those in its folder, and the built-in ones."""
        named: list[Path] = []
        if self.file.suffix.lower() == ".zmx":
            named = [*catalogues_in_folder(self.file), PLASTICS, *sorted(MAKERS.glob("*.agf"))]
        return tuple(dict.fromkeys([self.file, *self.catalogues, *named]))

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
    plastics: tuple[Material, ...] = Field(
        description="Materials with coefficients; a changed one redesigns its lenses."
    )
    design_name: str = Field(description="Name of its design.")
    design: DesignSettings | ImportedLens = Field(description="Design method, or file.")
    capture: CaptureSettings | None = Field(
        None, description="Changed capture settings of an ablation; null: those of the study."
    )
    fields: FieldSet | None = Field(
        None, description="Changed fields of the losses, of an ablation; null: those of the study."
    )

    @property
    def by_network(self) -> bool:
        """True if the loss of a network guides the design: of a classifier, or for another task."""
        return bool(self.design.by_network)

    @property
    def end_to_end(self) -> bool:
        """True if lens and network are trained together from the first descent, from flat plates or an imaging lens."""
        first = self.design.by_network[:1]
        return bool(first) and first[0].trains_network and not self.design.starting_designs

    @property
    def by_task(self) -> bool:
        """True if the supervisor of the study guides the design, frozen or trained jointly, but not end-to-end."""
        return self.by_network and not self.end_to_end and not self.design.task

    @property
    def by_accuracy(self) -> bool:
        """True if the most accurate of the possible starts is the start; otherwise it is the best by the criterion."""
        descents = self.design.descents
        return bool(descents) and (descents[-1].trains_network or not self.design.starting_designs)

    @property
    def by_psfs(self) -> bool:
        """True if a descent minimises a loss of captures or PSFs."""
        return any(descent.criterion != "spot" for descent in self.design.descents)

    @property
    def reads_images(self) -> bool:
        """True if a descent minimises a loss of captures, or the focus of an imported lens may do so."""
        return self.may_focus or any(descent.reads_images for descent in self.design.descents)

    @property
    def may_focus(self) -> bool:
        """True if the lens is imported, and a network may set its focus."""
        return isinstance(self.design, ImportedLens) and self.design.focus in (None, "network")

    @property
    def constrained(self) -> bool:
        """True if the lens has to keep the constraints and the focal length, which verification checks.

        False for imported lenses, and for designs from flat plates that need not converge: end-to-end designs, and
        designs by a network that begin with AdamW.
        """
        if isinstance(self.design, ImportedLens):
            return False
        may_fail = self.end_to_end or (self.by_network and self.design.descents[0].optimizer == "adamw")
        return not (may_fail and self.design.start == "flat")


class LensDesign(Frozen):
    """The part of a study that the design of one lens may read.

    Attributes:
        entry: the lens, its plastics and its method.
        spec, constraints: specification and limits.
        capture: for designs by captures.
        classifier: for designs supervised by a classifier.
        network: network of another task, for designs supervised by it.
        starts: lenses of which the best is the start, by `entry.by_accuracy`.
        fields: fields of the losses, fractions of the sensor; None: drawn anew in each step.
        averaged: fields over which figures are averaged, fractions of the sensor.
        rays: rays per field and colour for the figures.
        seed: seed of all random numbers.
    """

    entry: LensEntry
    spec: Spec
    constraints: Constraints
    capture: CaptureSettings | None
    classifier: ClassifierSettings | None
    network: TaskSettings | None
    starts: tuple[str, ...]
    fields: Points | None
    averaged: Points
    rays: int
    seed: int
