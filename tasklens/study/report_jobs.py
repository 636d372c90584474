"""Settings of the jobs that show lenses and results; no torch here."""

from typing import Any

from tasklens.settings import names
from tasklens.settings.base import Frozen
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.field_settings import Points, radii
from tasklens.settings.names import SHARP
from tasklens.settings.network_settings import ClassifierSettings, RestorationSettings
from tasklens.settings.specification import Spec
from tasklens.study import claims as paper_claims
from tasklens.study import table_contents
from tasklens.study.claims import Claims, PaperClaim
from tasklens.study.descriptions import description
from tasklens.study.loading import dump
from tasklens.study.study import RankingSettings, Study, StudyError
from tasklens.study.sweep import points
from tasklens.study.table_contents import LensKey, MeasuredKey, SeededLenses, SeededMeasurements


class FramesJob(Frozen):
    """A figure of whole frames through these lenses; `field` is a field of the grading, halfway to the corner."""

    comparison: Claims
    captures: dict[str, CaptureSettings]
    field: int

    @classmethod
    def of(cls, study: Study, elements: str, seed: int) -> "FramesJob":
        """Return the settings of the job."""
        comparison = paper_claims.comparison(study, elements, seed)
        captures = {lens: study.capture_of(lens) for lens in comparison.lenses}
        return cls(comparison=comparison, captures=captures, field=study.fields.halfway)


class CapturesJob(SeededMeasurements):
    """Test images through every lens of the tables in the first seed, and the answers of each network.

    Attributes:
        captures: settings of captures by lens.
        chosen_by: measured names of the supervisor by lens (or SHARP), whose predictions choose the images.
    """

    captures: dict[str, CaptureSettings]
    restoration: RestorationSettings | None
    classifiers: dict[str, ClassifierSettings]
    chosen_by: dict[str, str]

    @classmethod
    def of(cls, study: Study) -> "CapturesJob":
        """Return the settings of the job."""
        contents = table_contents.verification(study)
        used = dict.fromkeys(names.split(name)[0] for _, name in contents.measured)
        restored = any(names.split(name)[1] for _, name in contents.measured)
        chosen_by: dict[str, str] = {}  # unrestored captures come first, where they are measured
        for lens, name in sorted(contents.measured, key=lambda key: names.split(key[1])[1]):
            if names.split(name)[0] == study.supervisor:
                chosen_by.setdefault(lens, name)
        return cls(
            lenses=contents.lenses,
            measured=contents.measured,
            seeds=study.seeds[:1],
            captures={lens: study.capture_of(lens) for lens in contents.lenses},
            restoration=study.restoration if restored else None,
            classifiers={name: study.classifier(name) for name in used},
            chosen_by=chosen_by,
        )

    @property
    def restored_lenses(self) -> list[str]:
        """Lenses with a restoration network."""
        return sorted({lens for lens, name in self.measured if names.split(name)[1]})

    @property
    def restored_keys(self) -> list[LensKey]:
        """These lenses."""
        return [LensKey(lens, *self.seeds) for lens in self.restored_lenses]

    @property
    def supervised_keys(self) -> list[MeasuredKey]:
        """Measurements that choose the images."""
        return [MeasuredKey(*pair, *self.seeds) for pair in self.chosen_by.items()]


class TailsJob(SeededLenses):
    """The tables of core, tail and encircled energy of all PSFs."""

    study: str
    specs: dict[str, Spec]
    fields: Points
    rays: int

    @classmethod
    def of(cls, study: Study) -> "TailsJob":
        """Return the settings of the job."""
        lenses = table_contents.table_lenses(study)
        specs = {lens: study.lens_spec(lens) for lens in lenses}
        keys = {"study": study.name, "lenses": lenses, "seeds": study.seeds, "rays": study.evaluation_rays}
        return cls(**keys, specs=specs, fields=study.fields.grading_points)


class RankingJob(SeededMeasurements):
    """The table and the page of a ranking.

    Attributes:
        study: name of the study.
        model: name of the network in timm, or its function.
        facts: the section `ranking` of the study; its `mtf` includes the lenses that the sieve left out.
        sieved: lenses that the sieve left out.
        grade: tolerance grade of the lenses that are built in simulation.
        epochs: epochs of fine-tuning of the network on each lens.
    """

    study: str
    model: str
    facts: RankingSettings
    sieved: tuple[str, ...]
    grade: str
    epochs: float

    @classmethod
    def of(cls, study: Study) -> "RankingJob":
        """Return the settings of the job."""
        lenses = table_contents.table(study, "table1").lenses
        return cls(
            study=study.name,
            lenses=lenses,
            seeds=study.seeds[:1],
            measured=tuple((lens, study.supervisor) for lens in (SHARP, *lenses)),
            model=study.classifier(study.supervisor).model,
            facts=study.ranking,
            sieved=tuple(name for name in study.ranking.mtf if name not in study.lenses),
            grade=study.tolerances.grade.name,
            epochs=study.fine_tuning.epochs,
        )

    @property
    def built_keys(self) -> list[LensKey]:
        """Lenses that are built in simulation."""
        return [LensKey(lens, *self.seeds) for lens in self.facts.built]


class MeritFunctionJob(SeededLenses):
    """The table and figure of the merit function of each classifier."""

    study: str
    classifiers: tuple[str, ...]
    supervisor: str
    outside_window: str

    @classmethod
    def of(cls, study: Study) -> "MeritFunctionJob":
        """Return the settings of the job."""
        contents = table_contents.table(study, "table2" if "table2" in study.tables else "table1")
        return cls(
            study=study.name,
            lenses=contents.lenses,
            seeds=study.seeds,
            classifiers=contents.classifiers,
            supervisor=study.supervisor,
            outside_window=study.capture.outside_window,
        )

    @property
    def frozen_keys(self) -> list[MeasuredKey]:
        """Measurements of each lens by each classifier."""
        return [MeasuredKey(lens, name, seed) for lens, seed in self.lens_keys for name in self.classifiers]


class ReportJob(Frozen):
    """The page of a study, of its first seed.

    Attributes:
        elements: name of the elements by lens.
        descriptions: a sentence about each design.
        by_task: names of the task-driven lenses.
        by_classifier: names of the lenses whose design a network supervises.
        margins: margins of claims by their text.
        questions: texts of the main claims, in order.
        paper_claims: claims as the paper makes them, and the stronger one about image quality.
        with_optimum: names of the lenses whose descent has a local optimum.
        restored: names of the lenses with a restoration network.
        radii: distances of the fields of the grading from the axis, in units of that of the corner.
        design_radii: the same of the fields that designs see; empty if they are drawn.
        configuration: the resolved study as YAML.
    """

    study: str
    seeds: tuple[int, ...]
    supervisor: str
    tables: tuple[str, ...]
    elements: dict[str, str]
    descriptions: dict[str, str]
    by_task: tuple[str, ...]
    by_classifier: tuple[str, ...]
    margins: dict[str, float]
    questions: tuple[str, ...]
    paper_claims: tuple[PaperClaim, ...]
    with_optimum: tuple[str, ...]
    restored: tuple[str, ...]
    radii: tuple[float, ...]
    design_radii: tuple[float, ...]
    configuration: str

    @classmethod
    def of(cls, study: Study) -> "ReportJob":
        """Return the settings of the job."""
        contents = table_contents.verification(study)
        entries = {lens: study.lens(lens) for lens in contents.lenses}
        return cls(
            study=study.name,
            seeds=study.seeds,
            supervisor=study.supervisor,
            tables=tuple(table.name for table in contents.tables),
            elements={lens: entry.elements for lens, entry in entries.items()},
            descriptions={entry.design_name: description(entry) for entry in entries.values()},
            by_task=tuple(lens for lens, entry in entries.items() if entry.by_task),
            by_classifier=tuple(lens for lens, entry in entries.items() if entry.by_network),
            margins={claim.text: claim.margin for claim in paper_claims.claims(study).claims},
            questions=(paper_claims.OVER_IMAGE_QUALITY, paper_claims.OVER_LEAST_SQUARES, paper_claims.FEWER_ELEMENTS),
            paper_claims=paper_claims.PAPER_CLAIMS,
            with_optimum=contents.with_optimum,
            restored=tuple(lens for lens, name in contents.measured if names.split(name)[1]),
            radii=radii(study.fields.grading_points, study.spec.aspect),
            design_radii=radii(study.fields.design_points or (), study.spec.aspect),
            configuration=dump(study),
        )

    @property
    def lens_keys(self) -> list[LensKey]:
        """All lenses, in the first seed."""
        return [LensKey(lens, self.seeds[0]) for lens in self.elements]

    @property
    def restored_keys(self) -> list[LensKey]:
        """Lenses with a restoration network, in the first seed."""
        return [LensKey(lens, self.seeds[0]) for lens in self.restored]


class SweepJob(Frozen):
    """The table of all points of a sweep: the values of the swept keys by point, and its tables."""

    study: str
    points: dict[str, dict[str, Any]]
    tables: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, study: Study) -> "SweepJob":
        """Return the settings of the job; raises StudyError for a study without a sweep."""
        if not study.sweep:
            raise StudyError(f"{study.name}: has no sweep, of which this would be the table")
        grid = points(study.sweep)
        return cls(
            study=study.name,
            points=grid,
            tables=tuple((p, table.name) for p in grid for table in table_contents.tables(study)),
        )
