"""The claims of the paper (Yang et al. 2024, sections 4 and 5) about the lenses of a study; no torch here.

A claim belongs to one table: its classifier, and captures as they are or restored.
"""

from itertools import pairwise

from tasklens.pipeline import jobs
from tasklens.study.design_settings import EndToEnd, Task
from tasklens.study.settings import Frozen
from tasklens.study.study import Study, pick

IMAGING1 = "imaging1"  # the paper's spot minimisation; the other imaging designs are its strong lenses

OVER_IMAGING1 = "more accurate than imaging1"
OVER_STRONG = "more accurate than the best other imaging design"
OVER_IMAGING = "more accurate than the best imaging design"  # of any kind; only `regimes` asks
FEWER_ELEMENTS = "more accurate than the best imaging design with more elements"
OVER_END_TO_END = "at least as accurate as end-to-end design from imaging"
VARIED = "more accurate than the design that it varies"  # only `ablation` asks
FLAT_FAILS = "end-to-end design from flat does not converge"


class Claim(Frozen):
    """That one lens is better than the best of its rivals, or (`FLAT_FAILS`) that one design does not converge.

    Attributes:
        table: where the paper shows it, or what else of ours asks.
        text: one of the sentences above.
        lens: the lens that it is about.
        rivals: of these the one with the best minival accuracy is the opponent, of each seed anew; none for a lens
            judged alone.
        classifier: name under which it is measured, such as `resnet-restored` in table 4.
        reference: name under which the same classifier is measured on the pictures themselves.
    """

    table: str
    text: str
    lens: str
    rivals: tuple[str, ...]
    classifier: str
    reference: str


class VerdictsJob(Frozen):
    claims: tuple[Claim, ...]
    seeds: tuple[int, ...]


def verdicts(study: Study) -> VerdictsJob:
    """Every claim that the lenses of a study can decide, table by table."""
    found = []
    for table in jobs.tables(study):
        pairs = _end_to_end(study) if table.name == "table3" else _against_imaging(study)
        found += [
            Claim(
                table=table.name,
                text=text,
                lens=lens,
                rivals=rivals,
                classifier=table.seen(classifier),
                reference=classifier,
            )
            for classifier in table.classifiers
            for text, lens, rivals in pairs
            if {lens, *rivals} <= set(table.lenses)
        ]
    return VerdictsJob(claims=tuple(found), seeds=study.seeds)


def regimes(study: Study) -> VerdictsJob:
    """Each task-driven lens against the best imaging lens of its elements, with the supervisor (table 1)."""
    found = [
        Claim(
            table="table1",
            text=OVER_IMAGING,
            lens=lens.name,
            rivals=tuple(f"{lens.elements}-{name}" for name in study.imaging_designs),
            classifier=study.supervisor,
            reference=study.supervisor,
        )
        for lens in study.lenses.values()
        if isinstance(lens.design, Task)
    ]
    return VerdictsJob(claims=tuple(claim for claim in found if claim.rivals), seeds=study.seeds)


def over_imaging(study: Study, elements: str) -> Claim:
    """The claim of `regimes` about the first task-driven lens of these elements."""
    found = {claim.lens.partition("-")[0]: claim for claim in reversed(regimes(study).claims)}
    return pick(found, elements, "name of elements with a task-driven and an imaging design:")


class AblationJob(Frozen):
    name: str
    base: str  # lens
    verdicts: VerdictsJob  # a claim per variant


def ablation(study: Study, name: str) -> AblationJob:
    """Each variant of an ablation against the design that it varies, with the supervisor."""
    chosen = pick(study.ablations, name, "ablation")
    base = f"{chosen.elements}-{chosen.design}"
    variants = (f"{chosen.elements}-{chosen.name(name, variant)}" for variant in chosen.variants)
    found = tuple(
        Claim(
            table="ablation",
            text=VARIED,
            lens=lens,
            rivals=(base,),
            classifier=study.supervisor,
            reference=study.supervisor,
        )
        for lens in variants
    )
    return AblationJob(name=name, base=base, verdicts=VerdictsJob(claims=found, seeds=study.seeds))


def _against_imaging(study: Study) -> list[tuple[str, str, tuple[str, ...]]]:
    """Each task-driven lens against `imaging1`, the other imaging lenses, and those of the next number of elements."""
    found = []
    for lens in study.lenses.values():
        if isinstance(lens.design, Task):
            imaging = [
                other
                for other in study.lenses.values()
                if other.design_name in study.imaging_designs
                and study.spec_of(other.elements) == study.spec_of(lens.elements)
            ]
            counts = sorted({len(other.plastics) for other in imaging})
            more = dict(pairwise(counts)).get(len(lens.plastics))
            same = [other for other in imaging if other.elements == lens.elements]
            opposed = {
                OVER_IMAGING1: [other for other in same if other.design_name == IMAGING1],
                OVER_STRONG: [other for other in same if other.design_name != IMAGING1],
                FEWER_ELEMENTS: [other for other in imaging if len(other.plastics) == more],
            }
            found += [(text, lens.name, tuple(o.name for o in others)) for text, others in opposed.items() if others]
    return found


def _end_to_end(study: Study) -> list[tuple[str, str, tuple[str, ...]]]:
    """Each task-driven lens against end-to-end design from imaging; each end-to-end design from flat alone."""
    found = []
    for lens in study.lenses.values():
        if isinstance(lens.design, Task):
            found += [
                (OVER_END_TO_END, lens.name, (other.name,))
                for other in study.lenses.values()
                if other.elements == lens.elements
                and isinstance(other.design, EndToEnd)
                and other.design.start == "best_imaging"
            ]
        elif isinstance(lens.design, EndToEnd) and lens.design.start == "flat":
            found.append((FLAT_FAILS, lens.name, ()))
    return found
