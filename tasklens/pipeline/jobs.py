"""Every job of a study, declared once: its settings, its inputs and its outputs.

The order is that of the data: images, classifiers, lenses, PSFs, restorations, accuracies, then what tells of them.
"""

from pathlib import Path
from typing import Any

from tasklens.pipeline.digest import folder_digest
from tasklens.pipeline.stage import Plan, Slice, stage
from tasklens.study import claims as paper_claims
from tasklens.study import names
from tasklens.study import tables as paper_tables
from tasklens.study.claims import Claims
from tasklens.study.design_settings import EndToEndSettings, ImportedLens, LensDesign, TaskDrivenSettings
from tasklens.study.names import SHARP
from tasklens.study.study import Study

SPLITS = ("train", "minival", "test")
PAPER = str(Path(__file__).parents[1] / "report" / "paper.csv")  # the values that the paper prints


# ---- images and classifiers


@stage(
    {
        f"{split}{part}": f"images/{split}{suffix}"
        for split in SPLITS
        for part, suffix in (("", ".npy"), ("_labels", ".json"))
    },
    resumable=True,
    threads=8,
)
def images(study: Study) -> Plan:
    folder = study.images.folder
    return Plan(Slice(images=study.images, source=None if folder is None else folder_digest(folder)))


def split(study: Study, name: str) -> list[str]:
    """Images and labels of a split."""
    return [images.output(study, name), images.output(study, f"{name}_labels")]


@stage({"weights": "classifiers/reference/{classifier}.safetensors"}, resumable=True)
def reference(study: Study, classifier: str) -> Plan:
    settings = study.classifier(classifier)
    return Plan(settings, {"train": split(study, "train"), "published": settings.weights}, gpus=1)


# ---- lenses and their PSFs


@stage(
    {"lens": "lenses/{lens}/seed{seed}/lens.yaml", "history": "lenses/{lens}/seed{seed}/history.csv"},
    resumable=True,
    priority=1,  # most jobs wait for designs, and the longest jobs are among them
)
def design(study: Study, lens: str, seed: int) -> Plan:
    entry = study.lens(lens)
    supervised = isinstance(entry.design, TaskDrivenSettings | EndToEndSettings)
    settings = LensDesign(
        entry=entry.model_copy(update={"capture": None}),  # what a design reads of it stands in `capture`
        spec=study.spec_of(entry.elements),
        constraints=study.constraints,
        capture=study.capture_of(lens) if supervised else None,
        classifier=study.classifier(study.supervisor) if supervised else None,
        rays=study.evaluation_rays,
        seed=seed,
    )
    inputs: dict[str, Any] = {"train": None, "weights": None}
    if supervised:
        inputs["train"] = split(study, "train")
        inputs["weights"] = reference.output(study, "weights", classifier=study.supervisor)
    if isinstance(entry.design, ImportedLens):
        inputs["files"] = [entry.design.file, *entry.design.catalogues]
    baselines = paper_tables.imaging_baselines(study, lens)
    inputs["baselines"] = {name: design.output(study, "lens", lens=name, seed=seed) for name in baselines}
    inputs["metrics"] = {name: _metrics(study, name, study.supervisor, seed) for name in baselines}
    return Plan(settings, inputs, gpus=int(supervised))


@stage({"psf": "lenses/{lens}/seed{seed}/psf.safetensors"})
def psf(study: Study, lens: str, seed: int) -> Plan:
    spec = study.spec_of(study.lens(lens).elements)
    return Plan(Slice(spec=spec, rays=study.evaluation_rays), {"lens": _lens(study, lens, seed)})


@stage({name: f"lenses/{{lens}}/seed{{seed}}/{name}.csv" for name in ("psf_tail", "encircled_energy")})
def tail(study: Study, lens: str, seed: int) -> Plan:
    return psf.plan(study, lens, seed)


def _lens(study: Study, lens: str, seed: int) -> str:
    return design.output(study, "lens", lens=lens, seed=seed)


def _psf(study: Study, lens: str, seed: int) -> str | None:
    return None if lens == SHARP else psf.output(study, "psf", lens=lens, seed=seed)


# ---- restorations and accuracies


@stage(
    {
        "weights": "restoration/{lens}/seed{seed}/nafnet.safetensors",
        "history": "restoration/{lens}/seed{seed}/history.csv",
    },
    resumable=True,
    priority=1,  # of the jobs that can run, the one that another, as long, waits for
)
def restore(study: Study, lens: str, seed: int) -> Plan:
    settings = Slice(restoration=study.restoration, capture=study.capture_of(lens), seed=seed)
    images = {name: split(study, name) for name in ("train", "minival")}
    return Plan(settings, {"images": images, "psf": _psf(study, lens, seed)}, gpus=1)


def _captures(study: Study, lens: str, measured_name: str, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings and inputs of the captures, restored or not, on which a classifier is measured under a name."""
    classifier, restored = names.split(measured_name)
    settings = {
        "classifier": study.classifier(classifier),
        "capture": None if lens == SHARP else study.capture_of(lens),
        "restoration": study.restoration if restored else None,
    }
    restoration = restore.output(study, "weights", lens=lens, seed=seed) if restored else None
    return settings, {"psf": _psf(study, lens, seed), "restoration": restoration}


@stage(
    {
        "weights": "classifiers/{lens}/seed{seed}/{measured_name}.safetensors",
        "metrics": "metrics/{lens}/seed{seed}/{measured_name}.csv",
        "predictions": "metrics/{lens}/seed{seed}/{measured_name}-predictions.csv",
    },
    resumable=True,
)
def fine_tune(study: Study, lens: str, measured_name: str, seed: int) -> Plan:
    classifier, restored = names.split(measured_name)
    captures, inputs = _captures(study, lens, measured_name, seed)
    rows = {
        "elements": "" if lens == SHARP else study.lens(lens).elements,
        "design": "reference" if lens == SHARP else study.lens(lens).design_name,
        "classifier": classifier,
        "restored": restored,
        "seed": seed,
    }
    inputs["images"] = {name: split(study, name) for name in SPLITS}
    inputs["weights"] = reference.output(study, "weights", classifier=classifier)
    processes = study.classifier(classifier).processes
    settings = Slice(**captures, training=study.fine_tuning, rows=rows, seed=seed)
    return Plan(settings, inputs, processes=processes, gpus=processes)


@stage({"predictions": "verification/{lens}/seed{seed}/{measured_name}-predictions.csv"}, resumable=True)
def reproduce(study: Study, lens: str, measured_name: str, seed: int) -> Plan:
    captures, inputs = _captures(study, lens, measured_name, seed)
    inputs["test"] = split(study, "test")
    inputs["weights"] = _metrics(study, lens, measured_name, seed, "weights")
    return Plan(Slice(**captures), inputs, gpus=1)


def _metrics(study: Study, lens: str, measured_name: str, seed: int, output: str = "metrics") -> str:
    """An output of fine-tuning a classifier, by the name under which it is measured."""
    return fine_tune.output(study, output, lens=lens, measured_name=measured_name, seed=seed)


# ---- tables, verdicts and figures

Measured = tuple[tuple[str, str], ...]  # pairs of a lens, or SHARP, and the name under which a classifier is measured


def _measurements(study: Study, lenses: tuple[str, ...], measured: Measured) -> dict[str, Any]:
    """Files of lenses by (lens, seed), and metrics and predictions by (lens, measured name, seed)."""
    keys = [(*pair, seed) for pair in measured for seed in study.seeds]
    return {
        "lenses": {(lens, seed): _lens(study, lens, seed) for lens in lenses for seed in study.seeds},
        "metrics": {key: _metrics(study, *key) for key in keys},
        "predictions": {key: _metrics(study, *key, output="predictions") for key in keys},
    }


def _claimed(study: Study, claims: Claims) -> dict[str, Any]:
    """What claims are judged by."""
    lenses = dict.fromkeys(lens for claim in claims.claims for lens in claim.lenses)
    measured = dict.fromkeys((lens, claim.classifier) for claim in claims.claims for lens in claim.lenses)
    sharp = dict.fromkeys((SHARP, claim.reference) for claim in claims.claims if claim.about_convergence)
    return _measurements(study, tuple(lenses), (*measured, *sharp))


def _published(name: str, *suffixes: str) -> dict[str, str]:
    """Files of a table, by their suffix."""
    return {suffix.replace(".", "_"): f"tables/{name}.{suffix}" for suffix in (*suffixes, "csv", "md")}


@stage(_published("{table}", "seeds.csv", "tex", "json"))
def table(study: Study, table: str) -> Plan:
    contents = paper_tables.table(study, table)
    inputs = _measurements(study, contents.lenses, contents.measured)
    return Plan(contents, {"lenses": inputs["lenses"], "metrics": inputs["metrics"], "paper": PAPER})


@stage(_published("psf_tail") | {"encircled_energy": "tables/encircled_energy.csv"})
def psf_tail(study: Study) -> Plan:
    lenses = paper_tables.table_lenses(study)
    keys = [(lens, seed) for lens in lenses for seed in study.seeds]
    inputs = {name: {(x, s): tail.output(study, name, lens=x, seed=s) for x, s in keys} for name in tail.patterns}
    return Plan(paper_tables.TailContents(study=study.name, lenses=lenses, seeds=study.seeds), inputs)


@stage(_published("verdicts"))
def verdicts(study: Study) -> Plan:
    claims = paper_claims.claims(study)
    return Plan(claims, _claimed(study, claims))


@stage(_published("regimes"))
def regimes(study: Study) -> Plan:
    claims = paper_claims.regime_claims(study)
    return Plan(claims, _claimed(study, claims))


@stage(_published("ablation_{ablation}"))
def ablation(study: Study, ablation: str) -> Plan:
    compared = paper_claims.ablation_claims(study, ablation)
    return Plan(compared, _claimed(study, compared.claims))


@stage({"page": "lenses/{lens}/seed{seed}/certificate.md"})
def certificate(study: Study, lens: str, seed: int) -> Plan:
    return Plan(Slice(title=f"{lens}, seed {seed}"), {"lens": _lens(study, lens, seed)})


@stage({"figure": "figures/{lens}-seed{seed}.png"})
def figure(study: Study, lens: str, seed: int) -> Plan:
    return Plan(Slice(title=lens), {"lens": _lens(study, lens, seed), "psf": _psf(study, lens, seed)})


@stage({"figure": "figures/figure3-{elements}-seed{seed}.png"})
def comparison(study: Study, elements: str, seed: int) -> Plan:
    claim = paper_claims.regime_claim(study, elements)
    inputs = {
        "lenses": {lens: _lens(study, lens, seed) for lens in claim.lenses},
        "psfs": {lens: _psf(study, lens, seed) for lens in claim.lenses},
        "metrics": {lens: _metrics(study, lens, claim.classifier, seed) for lens in claim.baselines},
    }
    return Plan(Slice(claim=claim, seed=seed), inputs)


@stage({})  # no output: asked for again, it verifies again
def verify(study: Study) -> Plan:
    lenses = paper_tables.table_lenses(study)
    entries = {name: study.lens(name) for name in lenses}
    tables, measured = paper_tables.tables(study), paper_tables.table_measurements(study)
    settings = paper_tables.VerificationContents(
        lenses=lenses,
        constrained=tuple(name for name, lens in entries.items() if lens.constrained),
        efl_mm={name: study.spec_of(lens.elements).efl_mm for name, lens in entries.items()},
        tables=tables,
        measured=measured,
        seeds=study.seeds,
    )
    reproduced = {
        (lens, name, seed): reproduce.output(study, "predictions", lens=lens, measured_name=name, seed=seed)
        for lens, name in measured
        for seed in study.seeds
    }
    inputs = _measurements(study, lenses, measured) | {
        "reproduced": reproduced,
        "tables": {contents.name: table.output(study, "csv", table=contents.name) for contents in tables},
        "verdicts": verdicts.output(study, "md"),
    }
    return Plan(settings, inputs)
