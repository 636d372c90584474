"""Effort of the designs of a study, and the lenses that they were chosen from; no torch here."""

from tasklens.settings.base import Frozen
from tasklens.settings.design_settings import DesignSettings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import ImportedLens
from tasklens.study.study import Study
from tasklens.study.table_contents import LensKey, candidates, starts, table_lenses


class Effort(Frozen):
    """Effort of the design of one lens.

    Attributes:
        lens: name of the lens.
        tried: lens evaluations: steps of descents, or evaluations of the least-squares search, without its last tens to
            hundreds under strict limits; zero for imported lenses.
        chosen_from: names of the lenses that may have been its start, of their possible starts, and so on.
    """

    lens: str
    tried: int
    chosen_from: tuple[str, ...]


class Efforts(Frozen):
    """Efforts of all designs in the tables of a study, and of the designs that they were chosen from."""

    study: str
    seeds: tuple[int, ...]
    efforts: tuple[Effort, ...]

    @property
    def lens_keys(self) -> list[LensKey]:
        """All lenses."""
        return [LensKey(entry.lens, seed) for entry in self.efforts for seed in self.seeds]


def effort(study: Study) -> Efforts:
    """Return the efforts of a study."""
    lenses = dict.fromkeys(table_lenses(study))
    lenses |= dict.fromkeys(other for lens in lenses for other in _chosen_from(study, lens))
    efforts = (
        Effort(lens=name, tried=_count_candidates(study.lens(name).design), chosen_from=_chosen_from(study, name))
        for name in study.lenses
        if name in lenses
    )
    return Efforts(study=study.name, seeds=study.seeds, efforts=tuple(efforts))


def _chosen_from(study: Study, lens: str) -> tuple[str, ...]:
    nearest = (*candidates(study, lens), *starts(study, lens))
    return tuple(dict.fromkeys([*nearest, *(other for near in nearest for other in _chosen_from(study, near))]))


def _count_candidates(design: DesignSettings | ImportedLens) -> int:
    if isinstance(design, ImportedLens):
        return 0
    if isinstance(design, LeastSquaresSettings):
        return design.evaluations
    return sum(descent.lenses * descent.steps for descent in design.descents)
