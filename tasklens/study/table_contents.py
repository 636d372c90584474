"""Contents of the tables, the designs and the verification of a study; no torch here."""

from collections.abc import Iterable
from typing import NamedTuple

from tasklens.fields import GRADING_CENTRES, PAPER
from tasklens.settings import names
from tasklens.settings.base import Frozen
from tasklens.settings.lens_entries import LensDesign
from tasklens.settings.names import SHARP
from tasklens.settings.starts import starting_designs
from tasklens.study.study import Study

_SEEDS = 1000  # distance between the seeds of designs for two sets of images: each set has draws of its own


class LensKey(NamedTuple):
    """Wildcards of the files of a lens."""

    lens: str
    seed: int


class MeasuredKey(NamedTuple):
    """Wildcards of the files of a measurement; `lens` may be SHARP."""

    lens: str
    measured_name: str
    seed: int


class SeededLenses(Frozen):
    """Lenses of a table, each in all seeds."""

    lenses: tuple[str, ...]
    seeds: tuple[int, ...]

    @property
    def lens_keys(self) -> list[LensKey]:
        """All lenses."""
        return [LensKey(lens, seed) for lens in self.lenses for seed in self.seeds]


class SeededMeasurements(SeededLenses):
    """Lenses and measurements of tables, each in all seeds.

    Attributes:
        measured: (lens or SHARP, measured name) of every measurement.
    """

    measured: tuple[tuple[str, str], ...]

    @property
    def measured_keys(self) -> list[MeasuredKey]:
        """All measurements."""
        return [MeasuredKey(*pair, seed) for pair in self.measured for seed in self.seeds]


class TableContents(SeededMeasurements):
    """Contents of one table of the paper.

    Attributes:
        study: name of the study.
        name: `table1` .. `table4`.
        lenses, classifiers, seeds: names and seeds of its rows.
        restored: whether captures are restored.
        gaps: in table 1, the other lenses that the optimality gap of a supervised lens compares, by this lens.
    """

    study: str
    name: str
    classifiers: tuple[str, ...]
    restored: bool
    gaps: dict[str, tuple[str, ...]]

    @property
    def frozen_keys(self) -> list[MeasuredKey]:
        """Measurements whose losses before fine-tuning are in the table."""
        return self.measured_keys if self.name in ("table1", "table3") else []


def table(study: Study, name: str) -> TableContents:
    """Return the contents of a table of the paper.

    Tables 1, 2 and 4 compare task-driven designs with imaging designs and imported lenses, table 3 with end-to-end
    designs; table 4 has only the elements in `restored`. Table 2 has all classifiers, the others the supervisor.
    """
    lenses = [
        lens
        for lens in study.lenses.values()
        if not lens.design.task and (lens.by_network if name == "table3" else lens.by_task or not lens.by_network)
    ]
    if name == "table4" and study.restored is not None:
        lenses = [lens for lens in lenses if lens.elements in study.restored]
    classifiers, restored = tuple(study.classifiers) if name == "table2" else (study.supervisor,), name == "table4"
    sharp = [(SHARP, classifier) for classifier in classifiers]
    captures = [(lens.name, names.measured_name(classifier, restored)) for lens in lenses for classifier in classifiers]
    return TableContents(
        study=study.name,
        name=name,
        lenses=tuple(lens.name for lens in lenses),
        classifiers=classifiers,
        seeds=study.seeds,
        measured=(*sharp, *captures),
        restored=restored,
        gaps=_gaps(study, [lens.name for lens in lenses]) if name == "table1" else {},
    )


def _gaps(study: Study, lenses: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the other constrained lenses of the same elements, by supervised lens."""
    entries = [study.lens(name) for name in lenses]
    return {
        lens.name: tuple(
            other.name for other in entries if other.elements == lens.elements and other != lens and other.constrained
        )
        for lens in entries
        if lens.by_psfs
    }


def tables(study: Study) -> tuple[TableContents, ...]:
    """Return the contents of all tables of the study that have lenses."""
    return tuple(contents for contents in (table(study, name) for name in study.tables) if contents.lenses)


def table_lenses(study: Study) -> tuple[str, ...]:
    """Return the names of all lenses in the tables of the study."""
    in_tables = {lens for contents in tables(study) for lens in contents.lenses}
    return tuple(lens for lens in study.lenses if lens in in_tables)


def lens_design(study: Study, lens: str, seed: int) -> LensDesign:
    """Return the part of a study that the design of a lens may read; raises StudyError."""
    entry = study.lens(lens)
    by_supervisor = entry.may_focus or (entry.by_network and not entry.design.task)
    return LensDesign(
        entry=entry.model_copy(update={"capture": None, "fields": None}),  # given by `capture` and `fields` below
        spec=study.lens_spec(lens),
        constraints=study.constraints,
        capture=study.capture_of(lens).model_copy(update={"diffraction": False}) if entry.reads_images else None,
        classifier=study.classifier(study.supervisor) if by_supervisor else None,
        network=None if entry.design.task is None else study.task_network(entry.design.task),
        starts=starts(study, lens),
        fields=study.design_points(lens),
        averaged=PAPER if study.fields.grading == "paper" else GRADING_CENTRES,
        rays=study.evaluation_rays,
        seed=(seed + _SEEDS * study.images.seed) % 2**31,
    )


def starts(study: Study, lens: str) -> tuple[str, ...]:
    """Return the lenses that a design may start from.

    Imported lenses are only among them by name, so that importing a baseline changes no other row.
    """
    entry = study.lens(lens)
    return tuple(f"{entry.elements}-{name}" for name in starting_designs(entry.design, study.designs))


def chosen_lenses(study: Study, designs: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the lenses of these designs, or of these names; by default those of table 1."""
    if designs is None:
        return table(study, "table1").lenses
    return tuple(lens.name for lens in study.lenses.values() if {lens.design_name, lens.name} & {*designs})


class VerificationContents(SeededMeasurements):
    """Contents of the verification of a study: its tables, their lenses and their measurements.

    Attributes:
        lenses: names of the lenses in the tables.
        constrained: names of the constrained lenses.
        efl_mm: specified focal length by lens [mm].
        efl_tolerance: largest relative deviation from it.
        tables: tables whose accuracies are compared.
        with_optimum: names of the constrained lenses whose design minimises a loss of PSFs or captures.
        seeds: seeds of the study.
    """

    constrained: tuple[str, ...]
    efl_mm: dict[str, float]
    efl_tolerance: float
    tables: tuple[TableContents, ...]
    with_optimum: tuple[str, ...]


def verification(study: Study) -> VerificationContents:
    """Return the contents of the verification of a study."""
    entries = {name: study.lens(name) for name in table_lenses(study)}
    measured = tuple(dict.fromkeys(pair for contents in tables(study) for pair in contents.measured))
    return VerificationContents(
        lenses=tuple(entries),
        constrained=tuple(name for name, lens in entries.items() if lens.constrained),
        efl_mm={name: study.lens_spec(name).efl_mm for name in entries},
        efl_tolerance=study.constraints.efl_tolerance,
        tables=tables(study),
        measured=measured,
        with_optimum=tuple(name for name, lens in entries.items() if lens.by_psfs and lens.constrained),
        seeds=study.seeds,
    )
