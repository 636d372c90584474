"""`tasklens study ...`: study files and their results."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from tasklens.cli.options import parse_settings, with_options
from tasklens.cli.outputs import AsJson, Force, new_file, print_json
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, write_text
from tasklens.study import loading
from tasklens.study.loading import whole_study_name
from tasklens.study.run import changes, new_study, planning, runs
from tasklens.study.run.digest import SNAKEFILE
from tasklens.study.run.forecast import Durations, duration, durations_of
from tasklens.study.schema import schema as study_schema
from tasklens.study.study import Study

app = typer.Typer(no_args_is_help=True)

Files = Annotated[list[Path], typer.Argument(help="Study files; each overrides those before it.", show_default=False)]
Place = Annotated[Path, typer.Argument(help="Study file, or its results folder.", show_default=False)]


@dataclass(frozen=True)
class Answers:
    """Options that are asked for if they are missing."""

    images: Annotated[str | None, typer.Option(help="Folder of photographs, or `built-in`.")] = None
    networks: Annotated[
        str | None, typer.Option(help="Networks, such as resnet,vit, or names in timm; the first supervises.")
    ] = None
    elements: Annotated[str | None, typer.Option(help="Elements, such as doublet,triplet or mine=COC+OKP4.")] = None
    f_number: Annotated[float | None, typer.Option(help="F-number of the lenses.")] = None
    field_of_view: Annotated[float | None, typer.Option(help="Full field of view on the diagonal (degrees).")] = None
    seeds: Annotated[int | None, typer.Option(help="Number of seeds.")] = None
    minutes: Annotated[float | None, typer.Option(help="Time budget (minutes).")] = None
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask no questions; take defaults for missing options.")] = (
        False
    )

    def of(self, key: str, question: str, default: Any) -> Any:
        """Return the value of an option, or else the answer to a question."""
        value = getattr(self, key)
        return value if value is not None else default if self.yes else _prompt(question, default)


@dataclass(frozen=True)
class OwnNetwork:
    """The first network of a study, if it is the user's own."""

    weights: Annotated[Path | None, typer.Option(help="Weights of the first network, which is not trained again.")] = (
        None
    )
    outputs: Annotated[
        Literal["classes", "imagenet", "all_imagenet"],
        typer.Option(help="Outputs of the first network: the folder's classes, or ImageNet's."),
    ] = "classes"
    argument: Annotated[list[str] | None, typer.Option(help="Argument of the first network: img_size=64.")] = None

    def check(self) -> None:
        """Raise InputError if its weights are missing."""
        if self.weights is None and (self.outputs != "classes" or self.argument):
            raise InputError("--outputs, --argument: only with --weights FILE, of a network of your own")
        if self.weights is not None and not self.weights.is_file():
            raise FileError(f"--weights {self.weights}: no such file")


@app.command()
@with_options(answers=Answers, own_network=OwnNetwork)
def new(
    name: Annotated[str, typer.Argument(help="Name of the study; results are in results/<name>.", show_default=False)],
    *,
    answers: Answers,
    size: Annotated[int | None, typer.Option(help="Side of the images (pixels).")] = None,
    own_network: OwnNetwork,
    cores: Annotated[int, typer.Option(min=1, help="Number of cores.")] = 2,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Study file; by default NAME.yaml.")] = None,
    force: Force = False,
) -> None:
    """Write a commented study file that fits a time budget, from answers or options."""
    path = output or Path(f"{name}.yaml")
    new_file(path, force, ".yaml", ".yml")
    question = "Images: a folder with <class>/*, or train/<class>/* and test/<class>/*, or built-in"
    place = answers.of("images", question, "built-in")
    folder = None if place == "built-in" else Path(place)
    networks = answers.of("networks", "Networks (resnet, mobilenetv3, swin, vit, or names of timm)", "resnet")
    request = new_study.StudyRequest(
        name=name,
        folder=folder,
        size=size or (64 if folder is None else 224),
        networks=_words("--networks", networks),
        elements=_elements(answers.of("elements", "Elements (singlet, doublet, triplet, quadruplet)", "doublet")),
        f_number=answers.of("f_number", "F-number", 2.8),
        field_of_view_deg=answers.of("field_of_view", "Full field of view [degrees]", 68.8),
        seeds=answers.of("seeds", "Seeds", 1),
        weights=own_network.weights,
        outputs=own_network.outputs,
        arguments=parse_settings(own_network.argument or (), "--argument"),
    )
    own_network.check()
    minutes = answers.of("minutes", "Time to spend [minutes]", 30.0)
    new_study.check(request)
    cut, seconds = new_study.fit(request, minutes, cores)
    forecast = (
        f"about {duration(seconds)} on {cores} cores"
        if seconds
        else "of unknown duration: no study like it was measured"
    )
    write_text(path, new_study.text(request, cut, forecast, cores, path))
    print(f"{path}: {cut.words}, {forecast}")
    snakefile = "" if Path("Snakefile").is_file() else f" -s {SNAKEFILE}"
    print(f"Next:  tasklens study plan {path}\n       snakemake -j{cores} tables{snakefile} --configfile {path}")


def _prompt(question: str, default: Any) -> Any:
    try:
        return typer.prompt(question, default=default)
    except typer.Abort:
        raise InputError("no answer; --yes takes the defaults") from None


def _words(option: str, text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:
        raise InputError(f"{option}: expected names, separated by commas")
    return words


def _elements(text: str) -> dict[str, list[str]]:
    """Parse names of the default study's elements, and `name=PLASTIC+PLASTIC`."""
    elements = {}
    for word in _words("--elements", text):
        name, equals, plastics = word.partition("=")
        if not equals and name not in new_study.elements():
            choices = ", ".join(new_study.elements())
            raise InputError(f"--elements: unknown {name!r}; expected one of {choices}, or NAME=PLASTIC+PLASTIC")
        elements[name] = plastics.split("+") if equals else list(new_study.elements()[name])
    return elements


@app.command()
def check(
    files: Files,
    build: Annotated[
        bool, typer.Option("--build-networks", help="Build every classifier once, without weights.")
    ] = False,
    weight_files: Annotated[bool, typer.Option(help="Check that the weight files of all classifiers exist.")] = True,
) -> None:
    """Check a study file, its images and imported lenses; compile the tracer if necessary; print a summary."""
    from tasklens.study.run.checks import check as check_study

    for study in loading.at_points(loading.load(*files)):
        check_study(study, build, weight_files)
        counts = f"{len(study.lenses)} lenses, {len(study.classifiers)} classifiers"
        print(f"{study.name}: {counts}, seeds {list(study.seeds)}")


@app.command()
def plan(
    files: Files,
    target: Annotated[str, typer.Option(help="Target of the workflow.")] = "tables",
    cores: Annotated[int, typer.Option(min=1, help="Number of cores to plan for.")] = 2,
    as_json: AsJson = False,
) -> None:
    """Show the remaining jobs with their time, memory and disk space; nothing is run or written."""
    config = loading.load(*files)
    studies = {study.name: study for study in [config, *loading.at_points(config)]}
    plans = planning.plan(files, target) or {config.name: {}}
    if others := [name for name in plans if name not in studies]:
        raise InputError(f"--target {target}: has jobs of the study {others[0]}, not {config.name}; give its file")
    if as_json:
        planned = [_figures(studies[name], jobs, cores) for name, jobs in plans.items()]
        print_json({"study": config.name, "points": planned})
        return
    for name, jobs in plans.items():
        if config.sweep:
            print(f"\n{name}")
        _print_plan(studies[name], jobs, target, cores)


def _figures(study: Study, planned: dict[str, planning.Planned], cores: int) -> dict[str, Any]:
    """Return the remaining jobs of a study and their costs, for JSON."""
    durations = durations_of(study)
    seconds, unmeasured = durations.total(planning.remaining_rules(planned))
    disk_mb, unweighed = planning.disk_mb(study, planned)
    return {
        "study": study.name,
        "changed": [str(change) for change in changes.since_last_run(study)],
        "jobs": {rule: {k: v for k, v in asdict(jobs).items() if k != "files"} for rule, jobs in planned.items()},
        "seconds": seconds / cores,
        "memory_mb": planning.memory_mb(planned, durations),
        "disk_mb": disk_mb,
        "seconds_unknown_of": unmeasured,
        "disk_unknown_of": unweighed,
    }


def _print_plan(study: Study, planned: dict[str, planning.Planned], target: str, cores: int) -> None:
    durations, figures = durations_of(study), _figures(study, planned, cores)
    print(f"{'rule':<18} {'done':>5} {'missing':>8} {'rerun':>6}  {'per job':>10}")
    for rule, jobs in planned.items():
        seconds = durations.seconds(rule)
        per_job = "?" if seconds is None else duration(seconds)
        print(f"{rule:<18} {len(jobs.done):>5} {len(jobs.missing):>8} {len(jobs.rerun):>6}  {per_job:>10}")
    if figures["changed"]:
        print("Changed since the last run:", *figures["changed"], sep="\n  ")
    rules = planning.remaining_rules(planned)
    if not rules:
        print(f"{study.name}: nothing to do for {target}.")
        return
    print(durations.forecast(rules, cores))
    memory, disk = f"{figures['memory_mb']} MB for the largest job", f"{figures['disk_mb']:.0f} MB more"
    print(f"memory: {memory}; disk: {disk}{_but(figures['disk_unknown_of'])}")


def _but(unknown: list[str]) -> str:
    return f", not counting {', '.join(unknown)}, which are not measured yet" if unknown else ""


def _folder(place: Path) -> Path:
    """Return the results folder of a study; `place` is its study file or the results folder itself."""
    if place.is_dir():
        if not (place / "study.yaml").is_file():
            raise FileError(f"{place}: contains no study.yaml; expected the results of a study, results/<name>")
        return place
    return Path("results", loading.load(place).name)


@app.command()
def status(place: Place, as_json: AsJson = False) -> None:
    """Show running, finished and failed jobs, read from files; this also works for a study on a cluster."""
    folder = _folder(place)
    own, inside = runs.read(folder), [runs.read(path.parent) for path in sorted(folder.glob("*/run.json"))]
    points = [run for run in inside if run is not None and run.study == whole_study_name(run.study)]
    study_runs = points if own is None else [own, *points]
    if not study_runs:
        raise FileError(f"{folder}/run.json: no run of this study; `tasklens study plan` shows what remains")
    if as_json:
        name = folder.resolve().name if own is None else own.study
        print_json({"study": name, "points": [_state(run) for run in study_runs]})
        return
    pairs = [(run, Durations(run.study, run.folder)) for run in study_runs]
    if len(alive := [item for item in pairs if item[0].is_alive]) > 1:
        print(f"in all: {runs.headline(alive)}")
    for item in pairs:
        print("\n".join(runs.status(*item)))


def _state(run: runs.Run) -> dict[str, Any]:
    """Return the state of a run, for JSON."""
    running = {label: run.progress(label) for label in run.labels(runs.RUNNING)}
    left = runs.seconds_left([(run, Durations(run.study, run.folder))])
    return asdict(run) | {"alive": run.is_alive, "seconds_left": left, "progress": running}


@app.command("diff", hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def removed_diff() -> None:
    """Name the replacement of a command of version 1.0."""
    raise InputError("tasklens study diff: removed; use `diff -u` on files of results/ONE and results/OTHER")


@app.command("export", hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def removed_export() -> None:
    """Name the replacement of a command of version 1.0."""
    raise InputError(
        "tasklens study export: removed; use `tar -czf study.tar.gz --exclude '*/images' --exclude '*/checkpoints' "
        "--exclude '*.safetensors' results/NAME`, without images, checkpoints, weights and PSFs"
    )


@app.command()
def schema() -> None:
    """Print the JSON schema of study files, which editors use to complete and check them.

    With the YAML extension of VS Code: save it as study.schema.json, and begin a study file with

    # yaml-language-server: $schema=study.schema.json
    """
    print(json.dumps(study_schema(), indent=2))
