"""Declaration of all jobs of a study: function, settings, inputs and outputs.

The order is that of the data: images, classifiers, lenses, PSFs, restorations, accuracies, reports.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tasklens.pipeline.digest import folder_digest
from tasklens.pipeline.stage import Plan, stage
from tasklens.study import claims as paper_claims
from tasklens.study import names
from tasklens.study import tables as paper_tables
from tasklens.study.claims import Claims
from tasklens.study.design_settings import ImportedLens, LensDesign
from tasklens.study.names import SHARP, SPLITS
from tasklens.study.settings import Slice
from tasklens.study.study import Study, StudyError

PAPER = Path(__file__).parents[1] / "report" / "paper.csv"  # the paper's values
STAGES = "tasklens.pipeline.stages"
REPORT = "tasklens.report"


# ---- images and classifiers


@stage(
    f"{STAGES}.images.run",
    {n: f"images/{n}.npy" for n in SPLITS} | {f"{n}_labels": f"images/{n}.json" for n in SPLITS},
    resumable=True,
    threads=8,
)
def images(study: Study) -> Plan:
    """Render or read the images, and cut them into train, minival and test."""
    folder = study.images.folder
    return Plan(Slice(images=study.images, source=None if folder is None else folder_digest(folder)))


def split(study: Study, name: str) -> list[Path]:
    """Return the files of the images and the labels of a split."""
    return [images.output(study, name), images.output(study, f"{name}_labels")]


@stage(f"{STAGES}.reference.run", {"weights": "classifiers/reference/{classifier}.safetensors"}, resumable=True)
def reference(study: Study, classifier: str) -> Plan:
    """Train a classifier on the sharp images, or take its published weights."""
    settings = study.classifier(classifier)
    return Plan(settings, {"train": split(study, "train"), "published": settings.weights}, gpus=1)


# ---- lenses and their PSFs

_LENS = "lenses/{lens}/seed{seed}"


@stage(
    f"{STAGES}.design.run",
    {"lens": f"{_LENS}/lens.yaml", "history": f"{_LENS}/history.csv", "psf": f"{_LENS}/psf.safetensors"},
    resumable=True,
    priority=1,  # most jobs wait for designs, and the longest jobs are among them
)
def design(study: Study, lens: str, seed: int) -> Plan:
    """Design a lens, or import it; write its prescription, figures, history and PSFs."""
    entry = study.lens(lens)
    settings = LensDesign(
        entry=entry.model_copy(update={"capture": None}),  # given by `capture` below
        spec=study.spec_of(entry.elements),
        constraints=study.constraints,
        capture=study.capture_of(lens) if entry.supervised else None,
        classifier=study.classifier(study.supervisor) if entry.classified else None,
        rays=study.evaluation_rays,
        seed=seed,
    )
    baselines, candidates = paper_tables.imaging_baselines(study, lens), paper_tables.candidates(study, lens)
    inputs = {
        "train": split(study, "train") if entry.supervised else None,
        "weights": reference.output(study, "weights", classifier=study.supervisor) if entry.classified else None,
        "files": list(entry.design.sources) if isinstance(entry.design, ImportedLens) else None,
        "candidates": {name: _lens(study, name, seed) for name in candidates},
        "baselines": {name: _lens(study, name, seed) for name in baselines},
        "metrics": {name: _measured(study, name, study.supervisor, seed, "metrics") for name in baselines},
    }
    return Plan(settings, inputs, gpus=int(entry.supervised))


def _lens(study: Study, lens: str, seed: int) -> Path:
    return design.output(study, "lens", lens=lens, seed=seed)


def _psf(study: Study, lens: str, seed: int) -> Path | None:
    return None if lens == SHARP else design.output(study, "psf", lens=lens, seed=seed)


# ---- restorations and accuracies


@stage(
    f"{STAGES}.restore.run",
    {
        "weights": "restoration/{lens}/seed{seed}/nafnet.safetensors",
        "history": "restoration/{lens}/seed{seed}/history.csv",
    },
    resumable=True,
    priority=1,  # fine-tuning on restored captures, as long a job, waits for it
)
def restore(study: Study, lens: str, seed: int) -> Plan:
    """Train the restoration network on the captures of a lens."""
    settings = Slice(restoration=study.restoration, capture=study.capture_of(lens), seed=seed)
    images = {name: split(study, name) for name in ("train", "minival")}
    return Plan(settings, {"images": images, "psf": _psf(study, lens, seed)}, gpus=1)


def _captures(study: Study, lens: str, restored: bool, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return settings and inputs of the captures of a lens, restored or not."""
    capture = None if lens == SHARP else study.capture_of(lens)
    settings = {"capture": capture, "restoration": study.restoration if restored else None}
    restoration = restore.output(study, "weights", lens=lens, seed=seed) if restored else None
    return settings, {"psf": _psf(study, lens, seed), "restoration": restoration}


def _split(lens: str, measured_name: str) -> tuple[str, bool]:
    """Split a measured name into classifier and whether captures are restored; raises StudyError."""
    classifier, restored = names.split(measured_name)
    if restored and lens == SHARP:
        raise StudyError(f"{SHARP} images are not restored; expected the classifier {classifier}")
    return classifier, restored


def _fine_tuning(study: Study, lens: str, classifiers: Iterable[str], restored: bool, seed: int) -> Plan:
    """Plan the fine-tuning of classifiers on the captures of a lens."""
    chosen = {name: study.classifier(name) for name in classifiers}
    if not chosen:
        raise StudyError(f"classifiers: expected more than the supervisor {study.supervisor}")
    captures, inputs = _captures(study, lens, restored, seed)
    entry = None if lens == SHARP else study.lens(lens)
    elements, design_name = (entry.elements, entry.design_name) if entry else ("", "reference")
    rows = {"elements": elements, "design": design_name, "classifier": "", "restored": restored, "seed": seed}
    inputs["images"] = {name: split(study, name) for name in SPLITS}
    inputs["weights"] = {name: reference.output(study, "weights", classifier=name) for name in chosen}
    settings = Slice(**captures, classifiers=chosen, training=study.fine_tuning, rows=rows, seed=seed)
    processes = max(each.processes for each in chosen.values())
    return Plan(settings, inputs, processes=processes, gpus=processes)


_MEASUREMENTS = {
    "weights": "classifiers/{lens}/seed{seed}/{measured_name}.safetensors",
    "metrics": "metrics/{lens}/seed{seed}/{measured_name}.csv",
    "predictions": "metrics/{lens}/seed{seed}/{measured_name}-predictions.csv",
    "frozen": "metrics/{lens}/seed{seed}/{measured_name}-frozen.csv",  # losses before the training
}


@stage(f"{STAGES}.classify.fine_tune", _MEASUREMENTS, resumable=True)
def fine_tune(study: Study, lens: str, measured_name: str, seed: int) -> Plan:
    """Fine-tune a classifier on the captures of a lens, and measure it on every field, its loss also before that."""
    classifier, restored = _split(lens, measured_name)
    return _fine_tuning(study, lens, [classifier], restored, seed)


def others(study: Study) -> list[str]:
    """Return the classifiers but the supervisor, which stand in table 2 alone."""
    return [name for name in study.classifiers if name != study.supervisor]


def _measurements_of_others(study: Study) -> dict[str, str]:
    return {
        f"{output}_{name}": pattern.replace("{measured_name}", name)
        for name in others(study)
        for output, pattern in _MEASUREMENTS.items()
        if output != "frozen"  # of the supervisor alone
    }


@stage(f"{STAGES}.classify.fine_tune_others", _measurements_of_others, resumable=True)
def fine_tune_others(study: Study, lens: str, seed: int) -> Plan:
    """Fine-tune and measure all classifiers but the supervisor on the same captures, which are rendered once."""
    return _fine_tuning(study, lens, others(study), False, seed)


@stage(
    f"{STAGES}.classify.reproduce",
    {"predictions": "verification/{lens}/seed{seed}/{measured_name}-predictions.csv"},
    resumable=True,
)
def reproduce(study: Study, lens: str, measured_name: str, seed: int) -> Plan:
    """Classify the test images again with the stored weights, through the stored PSFs."""
    classifier, restored = _split(lens, measured_name)
    captures, inputs = _captures(study, lens, restored, seed)
    inputs["test"] = split(study, "test")
    inputs["weights"] = _measured(study, lens, measured_name, seed, "weights")
    return Plan(Slice(**captures, classifier=study.classifier(classifier)), inputs, gpus=1)


def _measured(study: Study, lens: str, measured_name: str, seed: int, output: str) -> Path:
    if measured_name in others(study):
        return fine_tune_others.output(study, f"{output}_{measured_name}", lens=lens, seed=seed)
    return fine_tune.output(study, output, lens=lens, measured_name=measured_name, seed=seed)


# ---- tables, verdicts and figures


def _measurements(study: Study, lenses: Iterable[str], measured: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Return files of lenses by (lens, seed); metrics, predictions, frozen losses by (lens, measured name, seed)."""
    keys = [(*pair, seed) for pair in measured for seed in study.seeds]
    files = {name: {key: _measured(study, *key, name) for key in keys} for name in ("metrics", "predictions")}
    files["frozen"] = {key: _measured(study, *key, "frozen") for key in keys if key[1] == study.supervisor}
    return files | {"lenses": {(lens, seed): _lens(study, lens, seed) for lens in lenses for seed in study.seeds}}


def _claimed(study: Study, claims: Claims) -> dict[str, Any]:
    """Return the files of measurements that claims need."""
    lenses = dict.fromkeys(lens for claim in claims.claims for lens in claim.lenses)
    measured = dict.fromkeys((lens, claim.classifier) for claim in claims.claims for lens in claim.lenses)
    sharp = dict.fromkeys((SHARP, claim.reference) for claim in claims.claims if not claim.baselines)
    return _measurements(study, lenses, measured | sharp)


def _published(name: str, *suffixes: str) -> dict[str, str]:
    """Return path patterns of the files of a table by suffix."""
    return {suffix.replace(".", "_"): f"tables/{name}.{suffix}" for suffix in (*suffixes, "csv", "md")}


@stage(f"{REPORT}.tables.make", _published("{table}", "seeds.csv", "tex", "json"))
def table(study: Study, table: str) -> Plan:
    """Make one table of the paper as CSV, Markdown and LaTeX."""
    contents = paper_tables.table(study, table)
    inputs = _measurements(study, contents.lenses, contents.measured)
    return Plan(contents, {name: inputs[name] for name in ("lenses", "metrics", "frozen")} | {"paper": PAPER})


@stage(
    f"{STAGES}.psf_tail.run",
    _published("psf_tail", "fields.csv") | {"encircled_energy": "tables/encircled_energy.csv"},
)
def psf_tail(study: Study) -> Plan:
    """Make the tables of core, tail and encircled energy of all PSFs."""
    lenses = paper_tables.table_lenses(study)
    specs = {lens: study.spec_of(study.lens(lens).elements) for lens in lenses}
    settings = Slice(study=study.name, lenses=lenses, seeds=study.seeds, specs=specs, rays=study.evaluation_rays)
    return Plan(settings, {"lenses": _measurements(study, lenses, ())["lenses"]})


@stage(f"{REPORT}.verdicts.make", _published("verdicts"))
def verdicts(study: Study) -> Plan:
    """Make the table of verdicts on the paper's claims from the measured accuracies."""
    claims = paper_claims.claims(study)
    return Plan(claims, _claimed(study, claims))


@stage(f"{REPORT}.regimes.make", _published("regimes"))
def regimes(study: Study) -> Plan:
    """Make the table of the gain of task-driven design by element counts and specifications."""
    claims = paper_claims.regime_claims(study)
    return Plan(claims, _claimed(study, claims))


@stage(f"{REPORT}.ablations.make", _published("ablation_{ablation}"))
def ablation(study: Study, ablation: str) -> Plan:
    """Make the table of one ablation: a design and its variants."""
    compared = paper_claims.ablation_claims(study, ablation)
    return Plan(compared, _claimed(study, compared.claims))


@stage(f"{STAGES}.certificate.run", {"page": f"{_LENS}/certificate.md", "figure": "figures/{lens}-seed{seed}.png"})
def certificate(study: Study, lens: str, seed: int) -> Plan:
    """Write the page of a lens, with limits and manufacturability, and draw it: cross-section, spot diagrams, PSFs."""
    return Plan(Slice(lens=lens, seed=seed), {"lens": _lens(study, lens, seed), "psf": _psf(study, lens, seed)})


@stage(f"{STAGES}.comparison.run", {"figure": "figures/figure3-{elements}-seed{seed}.png"})
def comparison(study: Study, elements: str, seed: int) -> Plan:
    """Draw the task-driven lens of some elements and the best imaging lens (figure 3)."""
    claim = paper_claims.regime_claim(study, elements)
    keys = [(lens, claim.classifier, seed) for lens in claim.baselines]
    inputs = {
        "lenses": {lens: _lens(study, lens, seed) for lens in claim.lenses},
        "psfs": {lens: _psf(study, lens, seed) for lens in claim.lenses},
        "metrics": {key: _measured(study, *key, "metrics") for key in keys},
    }
    return Plan(Slice(claim=claim, seed=seed), inputs)


@stage(f"{REPORT}.verification.run", {})  # without output, it runs on every request
def verify(study: Study) -> Plan:
    """Verify limits and accuracies of a finished study; print failures and verdicts."""
    contents = paper_tables.verification(study)
    inputs = _measurements(study, contents.lenses, contents.measured) | {
        "reproduced": {
            (lens, name, seed): reproduce.output(study, "predictions", lens=lens, measured_name=name, seed=seed)
            for lens, name in contents.measured
            for seed in study.seeds
        },
        "tables": {each.name: table.output(study, "csv", table=each.name) for each in contents.tables},
        "verdicts": verdicts.output(study, "md"),
    }
    return Plan(contents, inputs)
