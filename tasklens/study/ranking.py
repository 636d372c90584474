"""Settings of the ranking of lenses for a network; no torch here."""

from tasklens.settings.frozen import Frozen
from tasklens.settings.names import SHARP
from tasklens.study.ranking_settings import RankingSettings
from tasklens.study.study import Study
from tasklens.study.tables import LensKey, MeasuredKey, table


class RankingJob(Frozen):
    """The table and the page of a ranking.

    Attributes:
        study: name of the study.
        classifier: name of the network.
        model: its name in timm, or its function.
        lenses: names of the lenses.
        facts: the section `ranking` of the study; its `mtf` includes the lenses that the sieve left out.
        sieved: lenses that the sieve left out.
        grade: tolerance grade of the lenses that are built in simulation.
        epochs: epochs of fine-tuning of the network on each lens.
        seed: seed of the study.
    """

    study: str
    classifier: str
    model: str
    lenses: tuple[str, ...]
    facts: RankingSettings
    sieved: tuple[str, ...]
    grade: str
    epochs: float
    seed: int

    @classmethod
    def of(cls, study: Study) -> "RankingJob":
        """Return the settings of the job."""
        lenses = study.lenses
        return cls(
            study=study.name,
            classifier=study.supervisor,
            model=study.classifier(study.supervisor).model,
            lenses=table(study, "table1").lenses,
            facts=study.ranking,
            sieved=tuple(name for name in study.ranking.mtf if name not in lenses),
            grade=study.tolerances.grade.name,
            epochs=study.fine_tuning.epochs,
            seed=study.seeds[0],
        )

    @property
    def lens_keys(self) -> list[LensKey]:
        """All measured lenses."""
        return [LensKey(lens, self.seed) for lens in self.lenses]

    @property
    def measured_keys(self) -> list[MeasuredKey]:
        """All measurements, those of the sharp images first."""
        return [MeasuredKey(lens, self.classifier, self.seed) for lens in (SHARP, *self.lenses)]

    @property
    def built_keys(self) -> list[LensKey]:
        """Lenses that are built in simulation."""
        return [LensKey(lens, self.seed) for lens in self.facts.built]
