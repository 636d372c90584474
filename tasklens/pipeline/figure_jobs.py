"""Declaration of the jobs that show lenses and captures: certificates, comparisons, frames."""

from collections.abc import Iterable
from typing import Any

from tasklens.pipeline.jobs import LENS_FOLDER, STAGES, lens_file, measurement, psf_file, restore, split
from tasklens.pipeline.stage import Plan, stage
from tasklens.study import claims as paper_claims
from tasklens.study import names
from tasklens.study import tables as paper_tables
from tasklens.study.claims import Claim
from tasklens.study.settings import Slice
from tasklens.study.study import Study, pick


def _drawn(name: str) -> dict[str, str]:
    """Return path patterns of a figure in three formats."""
    return {"figure": f"figures/{name}.png"} | {f"figure_{kind}": f"figures/{name}.{kind}" for kind in ("svg", "pdf")}


@stage(
    f"{STAGES}.certificate.run",
    {
        "page": f"{LENS_FOLDER}/certificate.md",
        "zemax": f"{LENS_FOLDER}/{{lens}}.zmx",  # the catalogue beside it has its name
        "section": f"{LENS_FOLDER}/section.svg",
        **{name: f"{LENS_FOLDER}/{name}.webp" for name in ("spots", "psfs", "curves")},
        **_drawn("{lens}-seed{seed}"),
    },
)
def certificate(study: Study, lens: str, seed: int) -> Plan:
    """Write the page of a lens, with limits and manufacturability, and draw it: cross-section, spot diagrams, PSFs."""
    settings = Slice(lens=lens, seed=seed, grade=study.tolerances.grade)
    return Plan(settings, {"lens": lens_file(study, lens, seed), "psf": psf_file(study, lens, seed)})


@stage(f"{STAGES}.comparison.run", _drawn("figure3-{elements}-seed{seed}"))
def comparison(study: Study, elements: str, seed: int) -> Plan:
    """Draw the task-driven lenses of some elements and the best imaging lens (figure 3)."""
    claims, lenses = _compared(study, elements)
    return Plan(Slice(claims=claims, seed=seed), _drawn_lenses(study, claims, lenses, seed))


@stage(f"{STAGES}.frames.run", {"figure": "figures/figure4-{elements}-seed{seed}.png"})
def frames(study: Study, elements: str, seed: int) -> Plan:
    """Draw a chart and test images as frames through the task-driven lenses and the best imaging lens (figure 4)."""
    claims, lenses = _compared(study, elements)
    settings = Slice(claims=claims, captures={lens: study.capture_of(lens) for lens in lenses}, seed=seed)
    inputs = _drawn_lenses(study, claims, lenses, seed)
    inputs["test"] = split(study, "test")
    inputs["predictions"] = {lens: measurement(study, lens, study.supervisor, seed, "predictions") for lens in lenses}
    return Plan(settings, inputs)


def _compared(study: Study, elements: str) -> tuple[tuple[Claim, ...], list[str]]:
    """Return the claims of the task-driven lenses of some elements against imaging lenses, and all their lenses."""
    known = paper_claims.claims_by_elements(study)
    claims = pick(known, elements, "name of elements with a task-driven and an imaging design:")
    return tuple(claims), list(dict.fromkeys(lens for claim in claims for lens in claim.lenses))


def _drawn_lenses(study: Study, claims: Iterable[Claim], lenses: Iterable[str], seed: int) -> dict[str, Any]:
    """Return the files of lenses and PSFs, and the metrics of which the best imaging lens is found."""
    keys = dict.fromkeys((lens, claim.classifier, seed) for claim in claims for lens in claim.baselines)
    return {
        "lenses": {lens: lens_file(study, lens, seed) for lens in lenses},
        "psfs": {lens: psf_file(study, lens, seed) for lens in lenses},
        "metrics": {key: measurement(study, *key, "metrics") for key in keys},
    }


@stage(f"{STAGES}.captures.run", {"images": "figures/captures.safetensors", "answers": "tables/answers.csv"})
def captures(study: Study) -> Plan:
    """Take some test images through every lens, of the first seed, and let each network classify them."""
    contents, seed = paper_tables.verification(study), study.seeds[0]
    weights = {(lens, name): measurement(study, lens, name, seed, "weights") for lens, name in contents.measured}
    supervised = [lens for lens, name in contents.measured if name == study.supervisor]
    restored = {lens for lens, name in contents.measured if names.split(name)[1]}
    used = [names.split(name)[0] for _, name in contents.measured]
    settings = Slice(
        captures={lens: study.capture_of(lens) for lens in contents.lenses},
        restoration=study.restoration if restored else None,
        classifiers={name: study.network(name) for name in dict.fromkeys(used)},
    )
    inputs = {
        "test": split(study, "test"),
        "psfs": {lens: psf_file(study, lens, seed) for lens in contents.lenses},
        "restorations": {lens: restore.output(study, "weights", lens=lens, seed=seed) for lens in sorted(restored)},
        "weights": weights,
        "predictions": {lens: measurement(study, lens, study.supervisor, seed, "predictions") for lens in supervised},
    }
    return Plan(settings, inputs)
