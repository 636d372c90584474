"""Settings of the ranking of lenses for a network; no torch here."""

from tasklens.study.names import SHARP
from tasklens.study.settings import Frozen
from tasklens.study.study import Study
from tasklens.study.tables import LensKey, MeasuredKey, table


class RankingJob(Frozen):
    """The table and the page of a ranking.

    Attributes:
        study: name of the study.
        classifier: name of the network.
        model: its name in timm, or its function.
        lenses: names of the lenses.
        titles: display names of lenses, by lens.
        left_out: lenses that are not measured, with the reason.
        mtf: mean MTF by lens, the score of the sieve, including the lenses that it left out.
        sieved: lenses that the sieve left out.
        built: lenses that are built in simulation.
        grade: their tolerance grade.
        epochs: epochs of fine-tuning of the network on each lens.
        seed: seed of the study.
    """

    study: str
    classifier: str
    model: str
    lenses: tuple[str, ...]
    titles: dict[str, str]
    left_out: dict[str, str]
    mtf: dict[str, float]
    sieved: tuple[str, ...]
    built: tuple[str, ...]
    grade: str
    epochs: float
    seed: int

    @classmethod
    def of(cls, study: Study) -> "RankingJob":
        """Return the settings of the job."""
        ranking, lenses = study.ranking, study.lenses
        return cls(
            study=study.name,
            classifier=study.supervisor,
            model=study.classifier(study.supervisor).model,
            lenses=table(study, "table1").lenses,
            titles=ranking.titles,
            left_out=ranking.left_out,
            mtf=ranking.mtf,
            sieved=tuple(name for name in ranking.mtf if name not in lenses),
            built=ranking.built,
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
        return [LensKey(lens, self.seed) for lens in self.built]
