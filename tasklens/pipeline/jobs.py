"""What each job may read of a study.

A job is handed this slice and nothing else, and Snakemake compares it: by construction a changed value reruns the
jobs that read it and no others. What a job reads from other jobs are files.
"""

from tasklens.pipeline.layout import SHARP, restored
from tasklens.study.design_settings import EndToEnd, LeastSquares, Lens, Outside, Spot, Task
from tasklens.study.settings import Capture, Classifier, Constraints, Frozen, Images, Restoration, Spec, Training
from tasklens.study.study import Study


class ReferenceJob(Frozen):
    classifier: Classifier


class DesignJob(Frozen):
    lens: Lens
    spec: Spec
    constraints: Constraints
    capture: Capture | None
    classifier: Classifier | None
    rays: int
    seed: int


class PsfJob(Frozen):
    spec: Spec
    rays: int


class FineTuneJob(Frozen):
    elements: str
    design: str
    classifier: Classifier
    training: Training
    capture: Capture | None
    restoration: Restoration | None
    seed: int


class RestorationJob(Frozen):
    restoration: Restoration
    capture: Capture
    seed: int


class ReproductionJob(Frozen):
    classifier: Classifier
    capture: Capture | None
    restoration: Restoration | None


class TableJob(Frozen):
    name: str
    lenses: tuple[str, ...]
    classifiers: tuple[str, ...]
    seeds: tuple[int, ...]

    def seen(self, classifier: str) -> str:
        """Name under which a classifier is measured for this table: in table 4 it sees restored captures."""
        return restored(classifier) if self.name == "table4" else classifier

    @property
    def measured(self) -> tuple[tuple[str, str], ...]:
        """Lens (or SHARP) and classifier of every measurement that the table shows."""
        sharp = tuple((SHARP, classifier) for classifier in self.classifiers)
        return sharp + tuple((lens, self.seen(classifier)) for lens in self.lenses for classifier in self.classifiers)


class TailJob(Frozen):
    lenses: tuple[str, ...]
    seeds: tuple[int, ...]


class VerificationJob(Frozen):
    lenses: tuple[str, ...]
    promising: tuple[str, ...]  # those of `lenses` whose method promises to keep the constraints
    efl_mm: dict[str, float]
    tables: tuple[TableJob, ...]
    seeds: tuple[int, ...]

    @property
    def measured(self) -> tuple[tuple[str, str], ...]:
        """Lens (or SHARP) and classifier of every measurement that a table shows, each once."""
        return tuple(dict.fromkeys(pair for table in self.tables for pair in table.measured))


def images(study: Study) -> Images:
    return study.images


def reference(study: Study, classifier: str) -> ReferenceJob:
    return ReferenceJob(classifier=study.classifier(classifier))


def design(study: Study, lens: str, seed: int) -> DesignJob:
    chosen = study.lens(lens)
    supervised = isinstance(chosen.design, Task | EndToEnd)
    return DesignJob(
        lens=chosen.model_copy(update={"capture": None}),  # what a design reads of it stands in `capture`
        spec=study.spec_of(chosen.elements),
        constraints=study.constraints,
        capture=study.capture_of(lens) if supervised else None,
        classifier=study.classifier(study.supervisor) if supervised else None,
        rays=study.evaluation_rays,
        seed=seed,
    )


def psf(study: Study, lens: str) -> PsfJob:
    return PsfJob(spec=study.spec_of(study.lens(lens).elements), rays=study.evaluation_rays)


def fine_tune(study: Study, lens: str, classifier: str, seed: int, restored: bool) -> FineTuneJob:
    sharp = lens == SHARP
    chosen = None if sharp else study.lens(lens)
    return FineTuneJob(
        elements="" if sharp else chosen.elements,
        design="reference" if sharp else chosen.design_name,
        classifier=study.classifier(classifier),
        training=study.fine_tuning,
        capture=None if sharp else study.capture_of(lens),
        restoration=study.restoration if restored else None,
        seed=seed,
    )


def restore(study: Study, lens: str, seed: int) -> RestorationJob:
    return RestorationJob(restoration=study.restoration, capture=study.capture_of(lens), seed=seed)


def table(study: Study, name: str) -> TableJob:
    """Which lenses and classifiers stand in a table of the paper.

    Tables 1, 2 and 4 compare the task-driven with the imaging designs and the lenses from outside, table 3 with the
    end-to-end designs; table 4 those of the elements that are restored. Table 2 is about all classifiers, the others
    about the supervisor.
    """
    methods = (Task, EndToEnd) if name == "table3" else (Task, Spot, LeastSquares, Outside)
    shown = [lens for lens in study.lenses.values() if isinstance(lens.design, methods)]
    if name == "table4" and study.restored is not None:
        shown = [lens for lens in shown if lens.elements in study.restored]
    return TableJob(
        name=name,
        lenses=tuple(lens.name for lens in shown),
        classifiers=tuple(study.classifiers) if name == "table2" else (study.supervisor,),
        seeds=study.seeds,
    )


def reproduce(study: Study, lens: str, classifier: str, restored: bool) -> ReproductionJob:
    return ReproductionJob(
        classifier=study.classifier(classifier),
        capture=None if lens == SHARP else study.capture_of(lens),
        restoration=study.restoration if restored else None,
    )


def tables(study: Study) -> tuple[TableJob, ...]:
    """The tables that the study makes and has lenses for."""
    return tuple(job for job in (table(study, name) for name in study.tables) if job.lenses)


def shown(study: Study) -> tuple[str, ...]:
    """The lenses of these tables."""
    found = {lens for job in tables(study) for lens in job.lenses}
    return tuple(lens for lens in study.lenses if lens in found)


def psf_tail(study: Study) -> TailJob:
    return TailJob(lenses=shown(study), seeds=study.seeds)


def verify(study: Study) -> VerificationJob:
    """What is verified: the tables of a study, their lenses and their measurements."""
    lenses = {name: study.lens(name) for name in shown(study)}
    return VerificationJob(
        lenses=tuple(lenses),
        promising=tuple(name for name, lens in lenses.items() if lens.keeps_constraints),
        efl_mm={name: study.spec_of(lens.elements).efl_mm for name, lens in lenses.items()},
        tables=tables(study),
        seeds=study.seeds,
    )


def imaging_rivals(study: Study, lens: str) -> tuple[str, ...]:
    """The imaging lenses among which a design from the best imaging lens chooses; empty for every other design.

    Not the lenses from outside: naming an opponent changes no other row.
    """
    chosen = study.lens(lens)
    if not (isinstance(chosen.design, EndToEnd) and chosen.design.start == "best_imaging"):
        return ()
    return tuple(f"{chosen.elements}-{name}" for name in study.imaging_designs)
