"""Claims of the paper (Yang et al. 2024, sections 4 and 5) about the lenses of a study; no torch here.

A claim belongs to one table, which sets its classifier and whether captures are restored.
"""

from itertools import pairwise

from tasklens.settings import names
from tasklens.settings.base import Frozen
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import LensEntry
from tasklens.settings.names import SHARP
from tasklens.settings.starts import best_of, imaging_designs
from tasklens.study.study import Study, pick
from tasklens.study.table_contents import LensKey, MeasuredKey, starts, tables

IMAGING1 = "imaging1"  # the paper's spot minimisation

OVER_IMAGING1 = "more accurate than imaging1"
OVER_LEAST_SQUARES = "more accurate than the best lens by least squares"
OVER_IMAGING = "more accurate than the best imaging lens"  # of any kind; only in `claims_by_elements`
OVER_IMAGE_QUALITY = "more accurate than the best lens for image quality"  # of captures or PSFs, not of spots
FEWER_ELEMENTS = "more accurate than the best imaging lens with more elements"
OVER_START = "more accurate than the best lens that it may begin with"  # of designs with the network trained jointly
OVER_END_TO_END = "at least as accurate as end-to-end design from imaging lenses"
MARGIN = 1.0  # points by which a lens that is "at least as accurate" may be worse
OVER_BASE = "more accurate than the design that it varies"  # only in `ablation_claims`
FLAT_FAILS = "end-to-end design from flat plates fails"


class PaperClaim(Frozen):
    """A claim as the paper makes it, the table that tests it, and the texts of the comparisons that do."""

    sentence: str
    table: str
    texts: tuple[str, ...]
    of_the_paper: bool = True


_OVER_SPOTS = (OVER_IMAGING1, OVER_LEAST_SQUARES)  # the paper's imaging lenses have small spots
PAPER_CLAIMS = tuple(
    PaperClaim(sentence=sentence, table=table, texts=texts, of_the_paper=texts != (OVER_IMAGE_QUALITY,))
    for sentence, table, texts in (
        ("Task-driven lenses are more accurate than lenses with small spots.", "table1", _OVER_SPOTS),
        ("They are more accurate than imaging lenses with more elements.", "table1", (FEWER_ELEMENTS,)),
        ("With other networks too, they are more accurate than lenses with small spots.", "table2", _OVER_SPOTS),
        ("They are as accurate as end-to-end designs from imaging lenses.", "table3", (OVER_END_TO_END,)),
        ("End-to-end design from flat plates fails.", "table3", (FLAT_FAILS,)),
        ("After restoration too, they are more accurate than lenses with small spots.", "table4", _OVER_SPOTS),
        ("Not in the paper: they are more accurate than lenses for image quality.", "table1", (OVER_IMAGE_QUALITY,)),
    )
)


class Claim(Frozen):
    """A claim that a lens is better than its strongest baseline; without baselines, that its design fails.

    Attributes:
        table: table of the paper, or "ablation".
        text: one of the sentences above.
        lens: name of the lens.
        baselines: names of lenses; the strongest one of each seed has the best minival accuracy.
        classifier: measured name of the classifier on captures, such as `resnet-restored` in table 4.
        reference: name of the same classifier on the sharp images.
        margin: points by which the lens may be less accurate.
    """

    table: str
    text: str
    lens: str
    baselines: tuple[str, ...]
    classifier: str
    reference: str
    margin: float = 0.0

    @property
    def lenses(self) -> tuple[str, ...]:
        """The lens and its baselines."""
        return (self.lens, *self.baselines)


class Claims(Frozen):
    """Claims about the lenses of a study, tested together."""

    study: str
    claims: tuple[Claim, ...]
    seeds: tuple[int, ...]

    @property
    def lenses(self) -> list[str]:
        """All lenses that the claims compare."""
        return list(dict.fromkeys(lens for claim in self.claims for lens in claim.lenses))

    @property
    def lens_keys(self) -> list[LensKey]:
        """All lenses that the claims compare."""
        return [LensKey(lens, seed) for lens in self.lenses for seed in self.seeds]

    @property
    def baseline_keys(self) -> list[MeasuredKey]:
        """Measurements that say which baseline is the strongest."""
        pairs = dict.fromkeys((lens, claim.classifier) for claim in self.claims for lens in claim.baselines)
        return [MeasuredKey(*pair, seed) for pair in pairs for seed in self.seeds]

    @property
    def measured_keys(self) -> list[MeasuredKey]:
        """All measurements that the claims compare; without baselines also those on the sharp images."""
        pairs = dict.fromkeys((lens, claim.classifier) for claim in self.claims for lens in claim.lenses)
        pairs |= dict.fromkeys((SHARP, claim.reference) for claim in self.claims if not claim.baselines)
        return [MeasuredKey(*pair, seed) for pair in pairs for seed in self.seeds]


def claims(study: Study) -> Claims:
    """Return every claim for which a study has the lenses, table by table."""
    all_claims = []
    for table in tables(study):
        comparisons = _end_to_end(study) if table.name == "table3" else _against_imaging(study)
        all_claims += [
            Claim(
                table=table.name,
                text=text,
                lens=lens,
                baselines=baselines,
                classifier=names.measured_name(classifier, table.restored),
                reference=classifier,
                margin=MARGIN if text == OVER_END_TO_END else 0.0,
            )
            for classifier in table.classifiers
            if (table.name, classifier) != ("table2", study.supervisor) or "table1" not in study.tables  # made there
            for text, lens, baselines in comparisons
            if {lens, *baselines} <= set(table.lenses)
        ]
    return Claims(study=study.name, claims=tuple(all_claims), seeds=study.seeds)


def claims_by_elements(study: Study) -> dict[str, list[Claim]]:
    """Compare each task-driven lens with the best imaging lens of its elements, by the supervisor (table 1).

    Returns:
        Claims by names of elements.
    """
    by_elements: dict[str, list[Claim]] = {}
    for lens in study.lenses.values():
        if lens.by_task and imaging_designs(study.designs):
            imaging = [f"{lens.elements}-{name}" for name in imaging_designs(study.designs)]
            claim = _of_supervisor(study, "table1", OVER_IMAGING, lens.name, imaging)
            by_elements.setdefault(lens.elements, []).append(claim)
    return by_elements


def comparison(study: Study, elements: str, seed: int) -> Claims:
    """Compare the task-driven lenses of some elements with the best imaging lens, for one seed; raises StudyError."""
    kind = "name of elements with a task-driven and an imaging design:"
    return Claims(study=study.name, claims=tuple(pick(claims_by_elements(study), elements, kind)), seeds=(seed,))


def ablation_claims(study: Study, ablation: str) -> Claims:
    """Compare each variant of an ablation with its base lens, by the supervisor; raises StudyError."""
    entry = pick(study.ablations, ablation, "ablation")
    base = f"{entry.elements}-{entry.design}"
    variants = (f"{entry.elements}-{entry.name(ablation, variant)}" for variant in entry.variants)
    comparisons = tuple(_of_supervisor(study, "ablation", OVER_BASE, lens, [base]) for lens in variants)
    return Claims(study=study.name, claims=comparisons, seeds=study.seeds)


def _of_supervisor(study: Study, table: str, text: str, lens: str, baselines: list[str]) -> Claim:
    """Return a claim measured by the supervisor on captures without restoration."""
    return Claim(
        table=table,
        text=text,
        lens=lens,
        baselines=tuple(baselines),
        classifier=study.supervisor,
        reference=study.supervisor,
    )


def _against_imaging(study: Study) -> list[tuple[str, str, tuple[str, ...]]]:
    """Return (text, lens, baselines) of the claims that compare each task-driven lens with imaging lenses.

    The baselines are `imaging1`, designs by least squares, those by image error or contrast, all imaging lenses of
    the next larger number of elements, and, if a network is trained jointly, the lenses whose best is the start.
    """
    rows = []
    for lens in study.lenses.values():
        if lens.by_task:
            imaging = [
                other
                for other in study.lenses.values()
                if other.design_name in imaging_designs(study.designs)
                and study.lens_spec(other.name) == study.lens_spec(lens.name)
            ]
            counts = sorted({len(other.plastics) for other in imaging})
            more = dict(pairwise(counts)).get(len(lens.plastics))
            same = [other for other in imaging if other.elements == lens.elements]
            baselines: dict[str, list[LensEntry]] = {
                OVER_IMAGING1: [other for other in same if other.design_name == IMAGING1],
                OVER_LEAST_SQUARES: [other for other in same if isinstance(other.design, LeastSquaresSettings)],
                OVER_IMAGE_QUALITY: [other for other in same if other.by_psfs],
                FEWER_ELEMENTS: [other for other in imaging if len(other.plastics) == more],
                OVER_START: [study.lens(name) for name in starts(study, lens.name) if lens.by_accuracy],
            }
            rows += [(text, lens.name, tuple(o.name for o in others)) for text, others in baselines.items() if others]
    return rows


def _end_to_end(study: Study) -> list[tuple[str, str, tuple[str, ...]]]:
    """Return (text, lens, baselines) of the claims about end-to-end design, from imaging and from flat."""
    comparisons: list[tuple[str, str, tuple[str, ...]]] = []
    for lens in study.lenses.values():
        if lens.by_task:
            same = [other for other in study.lenses.values() if other.elements == lens.elements]
            comparisons += [
                (OVER_END_TO_END, lens.name, (other.name,))
                for other in same
                if other.end_to_end and other.design.start in best_of(study.designs)
            ]
        elif lens.end_to_end and lens.design.start == "flat" and lens.design.descents[0].optimizer == "adamw":
            comparisons.append((FLAT_FAILS, lens.name, ()))
    return comparisons
