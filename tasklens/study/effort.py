"""Effort of the designs of a study, and the lenses that they were chosen from; no torch here."""

from tasklens.settings.design_settings import DesignSettings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import ImportedLens
from tasklens.study.study import Study
from tasklens.study.table_contents import SeededLenses, starts, table_lenses


class Efforts(SeededLenses):
    """Efforts of all designs in the tables of a study, and of the designs that they were chosen from.

    Attributes:
        study: name of the study.
        tried: lens evaluations by lens: steps of descents, or evaluations of the least-squares search, without its last
            tens to hundreds under strict limits; zero for imported lenses.
        chosen_from: by lens, the lenses that may have been its start, their possible starts, and so on.
    """

    study: str
    tried: dict[str, int]
    chosen_from: dict[str, tuple[str, ...]]


def effort(study: Study) -> Efforts:
    """Return the efforts of a study."""
    in_tables = table_lenses(study)
    needed = {*in_tables, *(other for lens in in_tables for other in _chosen_from(study, lens))}
    lenses = tuple(lens for lens in study.lenses if lens in needed)
    return Efforts(
        study=study.name,
        lenses=lenses,
        seeds=study.seeds,
        tried={lens: _count_candidates(study.lens(lens).design) for lens in lenses},
        chosen_from={lens: _chosen_from(study, lens) for lens in lenses},
    )


def _chosen_from(study: Study, lens: str) -> tuple[str, ...]:
    nearest = starts(study, lens)
    return tuple(dict.fromkeys([*nearest, *(other for near in nearest for other in _chosen_from(study, near))]))


def _count_candidates(design: DesignSettings | ImportedLens) -> int:
    if isinstance(design, ImportedLens):
        return 0
    if isinstance(design, LeastSquaresSettings):
        return design.evaluations
    return sum(descent.lenses * descent.steps for descent in design.descents)
