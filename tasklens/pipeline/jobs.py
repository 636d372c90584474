"""Declaration of the jobs that make the results of a study: function, settings, inputs and outputs.

The order is that of the data: images, classifiers, lenses, PSFs, restorations, accuracies; `figure_jobs` and
`report_jobs` go on.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tasklens.pipeline.digest import folder_digest
from tasklens.pipeline.stage import Plan, stage
from tasklens.study import names
from tasklens.study import tables as paper_tables
from tasklens.study.lens_entries import ImportedLens
from tasklens.study.names import SHARP, SPLITS
from tasklens.study.settings import Slice
from tasklens.study.study import Study, StudyError

STAGES = "tasklens.pipeline.stages"


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
    settings = study.network(classifier)
    return Plan(settings, {"train": split(study, "train"), "published": settings.weights}, gpus=1)


# ---- images with objects, and networks of other tasks


@stage(
    f"{STAGES}.scenes.run",
    {name: f"images/scenes-{name}.npy" for name in ("train", "test")}
    | {f"{name}_objects": f"images/scenes-{name}.safetensors" for name in ("train", "test")},
)
def scenes(study: Study) -> Plan:
    """Render or read the images with objects, train and test."""
    folder = study.tasks.scenes.folder
    return Plan(Slice(scenes=study.tasks.scenes, source=None if folder is None else folder_digest(folder)))


def _scenes_split(study: Study, name: str) -> list[Path]:
    return [scenes.output(study, name), scenes.output(study, f"{name}_objects")]


@stage(f"{STAGES}.tasks.train", {"weights": "tasks/reference/{task}.safetensors"}, resumable=True)
def task_reference(study: Study, task: str) -> Plan:
    """Train the network of a task on the sharp images with objects."""
    network = study.task(task)
    settings = Slice(name=task, network=network.model_copy(update={"fine_tuning": network.training}))
    return Plan(settings, {"train": _scenes_split(study, "train")}, gpus=1)


# ---- lenses and their PSFs

LENS_FOLDER = "lenses/{lens}/seed{seed}"


@stage(
    f"{STAGES}.design.run",
    {
        "lens": f"{LENS_FOLDER}/lens.yaml",
        "history": f"{LENS_FOLDER}/history.csv",
        "psf": f"{LENS_FOLDER}/psf.safetensors",
    },
    resumable=True,
    priority=1,  # most jobs wait for designs, and the longest jobs are among them
)
def design(study: Study, lens: str, seed: int) -> Plan:
    """Design a lens, or import it; write its prescription, figures, history and PSFs."""
    entry = study.lens(lens)
    starts, candidates = paper_tables.starts(study, lens), paper_tables.candidates(study, lens)
    train = split(study, "train") if entry.supervised else None
    weights = reference.output(study, "weights", classifier=study.supervisor) if entry.classified else None
    if entry.other_task is not None:
        train, weights = _scenes_split(study, "train"), task_reference.output(study, "weights", task=entry.other_task)
    inputs = {
        "train": train,
        "weights": weights,
        "files": list(entry.design.sources) if isinstance(entry.design, ImportedLens) else None,
        "candidates": {name: lens_file(study, name, seed) for name in candidates},
        "starts": {name: lens_file(study, name, seed) for name in starts},
        "metrics": {name: measurement(study, name, study.supervisor, seed, "metrics") for name in starts},
    }
    return Plan(paper_tables.lens_design(study, lens, seed), inputs, gpus=int(entry.supervised))


def _diffraction_patterns(study: Study) -> dict[str, str]:
    captures = [study.capture_of(lens) for lens in (study.lenses | study.variants)]
    return {"psf": f"{LENS_FOLDER}/psf_diffraction.safetensors"} if any(each.diffraction for each in captures) else {}


@stage(f"{STAGES}.diffraction.run", _diffraction_patterns)
def diffraction(study: Study, lens: str, seed: int) -> Plan:
    """Compute the PSFs of a lens with diffraction."""
    spec = study.spec_of(study.lens(lens).elements)
    return Plan(Slice(spec=spec, rays=study.evaluation_rays), {"lens": lens_file(study, lens, seed)})


def lens_file(study: Study, lens: str, seed: int) -> Path:
    """Return the prescription of a lens."""
    return design.output(study, "lens", lens=lens, seed=seed)


def psf_file(study: Study, lens: str, seed: int) -> Path | None:
    """Return the PSFs of a lens, with diffraction if captures have it; None for sharp images."""
    if lens == SHARP:
        return None
    made = diffraction if study.capture_of(lens).diffraction else design
    return made.output(study, "psf", lens=lens, seed=seed)


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
    return Plan(settings, {"images": images, "psf": psf_file(study, lens, seed)}, gpus=1)


def _captures(study: Study, lens: str, restored: bool, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return settings and inputs of the captures of a lens, restored or not."""
    capture = None if lens == SHARP else study.capture_of(lens)
    settings = {"capture": capture, "restoration": study.restoration if restored else None}
    restoration = restore.output(study, "weights", lens=lens, seed=seed) if restored else None
    return settings, {"psf": psf_file(study, lens, seed), "restoration": restoration}


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
    inputs["weights"] = measurement(study, lens, measured_name, seed, "weights")
    return Plan(Slice(**captures, classifier=study.network(classifier)), inputs, gpus=1)


def measurement(study: Study, lens: str, measured_name: str, seed: int, output: str) -> Path:
    """Return an output of the measurement of a lens by a classifier, on restored captures or not."""
    if measured_name in others(study):
        return fine_tune_others.output(study, f"{output}_{measured_name}", lens=lens, seed=seed)
    return fine_tune.output(study, output, lens=lens, measured_name=measured_name, seed=seed)


# ---- other tasks through lenses


@stage(
    f"{STAGES}.tasks.fine_tune",
    {"weights": "tasks/{lens}/seed{seed}/{task}.safetensors", "metrics": "metrics/{lens}/seed{seed}/task-{task}.csv"},
    resumable=True,
)
def task_fine_tune(study: Study, lens: str, task: str, seed: int) -> Plan:
    """Fine-tune the network of a task on the captures of a lens, and score it at every field, also before that."""
    entry = None if lens == SHARP else study.lens(lens)
    elements, design_name = (entry.elements, entry.design_name) if entry else ("", "reference")
    settings = Slice(
        name=task,
        network=study.task(task),
        capture=None if lens == SHARP else study.capture_of(lens),
        rows={"elements": elements, "design": design_name, "task": task, "seed": seed},
        seed=seed,
    )
    inputs = {
        "scenes": {name: _scenes_split(study, name) for name in ("train", "test")},
        "weights": task_reference.output(study, "weights", task=task),
        "psf": psf_file(study, lens, seed),
    }
    return Plan(settings, inputs, gpus=1)


# ---- tolerances


@stage(
    f"{STAGES}.production.run",
    {
        "lenses": f"{LENS_FOLDER}/built-lenses.csv",
        "errors": f"{LENS_FOLDER}/errors.csv",
        "page": f"{LENS_FOLDER}/tolerances.md",
    },
    resumable=True,
)
def production(study: Study, lens: str, seed: int) -> Plan:
    """Build lenses of a design in simulation, with errors of manufacture, and measure them."""
    paper_tables.check_rays_alone(study)
    settings = Slice(
        lens=lens,
        seed=seed,
        spec=study.spec_of(study.lens(lens).elements),
        capture=study.capture_of(lens),
        classifier=study.network(study.supervisor),
        tolerances=study.tolerances.model_copy(update={"designs": None}),
    )
    inputs = {
        "lens": lens_file(study, lens, seed),
        "psf": design.output(study, "psf", lens=lens, seed=seed),
        "weights": measurement(study, lens, study.supervisor, seed, "weights"),
        "test": split(study, "test"),
        "minival": split(study, "minival"),
    }
    return Plan(settings, inputs, gpus=1)
