"""Which lenses and classifiers stand in the tables of a study; no torch here."""

from tasklens.study.design_settings import (
    EndToEndSettings,
    ImportedLens,
    LeastSquaresSettings,
    SpotSettings,
    TaskDrivenSettings,
)
from tasklens.study.names import SHARP, restored
from tasklens.study.settings import Frozen
from tasklens.study.study import Study


class TableContents(Frozen):
    """What one table of the paper shows.

    Attributes:
        study: name of the study.
        name: `table1` .. `table4`.
        lenses, classifiers, seeds: its rows.
        restored: whether its classifiers take restored captures.
    """

    study: str
    name: str
    lenses: tuple[str, ...]
    classifiers: tuple[str, ...]
    seeds: tuple[int, ...]
    restored: bool

    def measured_name(self, classifier: str) -> str:
        """Name under which a classifier is measured on captures for this table."""
        return restored(classifier) if self.restored else classifier

    @property
    def measured(self) -> tuple[tuple[str, str], ...]:
        """Lens (or SHARP) and classifier of every measurement that the table shows."""
        sharp = tuple((SHARP, classifier) for classifier in self.classifiers)
        captures = ((lens, self.measured_name(c)) for lens in self.lenses for c in self.classifiers)
        return sharp + tuple(captures)


def table(study: Study, name: str) -> TableContents:
    """The contents of a table of the paper.

    Tables 1, 2 and 4 compare the task-driven with the imaging designs and the imported lenses, table 3 with the
    end-to-end designs; table 4 those of the elements that are restored. Table 2 is about all classifiers, the others
    about the supervisor.
    """
    methods: tuple[type, ...] = (TaskDrivenSettings, SpotSettings, LeastSquaresSettings, ImportedLens)
    if name == "table3":
        methods = (TaskDrivenSettings, EndToEndSettings)
    lenses = [lens for lens in study.lenses.values() if isinstance(lens.design, methods)]
    if name == "table4" and study.restored is not None:
        lenses = [lens for lens in lenses if lens.elements in study.restored]
    return TableContents(
        study=study.name,
        name=name,
        lenses=tuple(lens.name for lens in lenses),
        classifiers=tuple(study.classifiers) if name == "table2" else (study.supervisor,),
        seeds=study.seeds,
        restored=name == "table4",
    )


def tables(study: Study) -> tuple[TableContents, ...]:
    """The tables that the study makes and has lenses for."""
    return tuple(contents for contents in (table(study, name) for name in study.tables) if contents.lenses)


def table_lenses(study: Study) -> tuple[str, ...]:
    """The lenses of these tables."""
    found = {lens for contents in tables(study) for lens in contents.lenses}
    return tuple(lens for lens in study.lenses if lens in found)


def imaging_baselines(study: Study, lens: str) -> tuple[str, ...]:
    """The imaging lenses among which a design from the best imaging lens chooses; empty for every other design.

    Not the imported lenses: importing a baseline changes no other row.
    """
    entry = study.lens(lens)
    if not (isinstance(entry.design, EndToEndSettings) and entry.design.start == "best_imaging"):
        return ()
    return tuple(f"{entry.elements}-{name}" for name in study.imaging_designs)


class VerificationContents(Frozen):
    """What is verified: the tables of a study, their lenses and their measurements.

    Attributes:
        lenses: of the tables.
        constrained: those whose method is required to keep the constraints.
        efl_mm: by lens, the specified focal length.
        tables: whose accuracies are compared.
        measured: lens (or SHARP) and classifier of every measurement in them, each once.
        seeds: of the study.
    """

    lenses: tuple[str, ...]
    constrained: tuple[str, ...]
    efl_mm: dict[str, float]
    tables: tuple[TableContents, ...]
    measured: tuple[tuple[str, str], ...]
    seeds: tuple[int, ...]


def verification(study: Study) -> VerificationContents:
    """What a study has to verify."""
    entries = {name: study.lens(name) for name in table_lenses(study)}
    return VerificationContents(
        lenses=tuple(entries),
        constrained=tuple(name for name, lens in entries.items() if lens.constrained),
        efl_mm={name: study.spec_of(lens.elements).efl_mm for name, lens in entries.items()},
        tables=tables(study),
        measured=tuple(dict.fromkeys(pair for contents in tables(study) for pair in contents.measured)),
        seeds=study.seeds,
    )
