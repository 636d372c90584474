"""Settings of the ranking of lenses for a network; no torch here."""

from tasklens.settings.names import SHARP
from tasklens.study.study import RankingSettings, Study
from tasklens.study.tables import LensKey, SeededMeasurements, table


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
        lenses = table(study, "table1").lenses
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
