"""Shared by all rules: studies, settings, functions and resources of jobs."""

from functools import cache
from inspect import signature

from pydantic_core import to_json
from snakemake.exceptions import WorkflowError

from tasklens.study.run.digest import code_digest
from tasklens.study.run.forecast import durations_of
from tasklens.settings import names
from tasklens.study import built_lenses, job_settings, report_jobs, task_jobs
from tasklens.study import claims as paper_claims
from tasklens.study import effort as paper_effort
from tasklens.study import table_contents
from tasklens.settings.lens_entries import ImportedLens
from tasklens.study.loading import parts, whole_study_name
from tasklens.study.study import StudyError
from tasklens.study.table_contents import LensKey, MeasuredKey


def flag(name, default):
    """Remove a key of the run, which is not part of the study, from the configuration; `--config` gives text."""
    value = str(config.pop(name, default)).lower()
    if value not in ("true", "false"):
        raise WorkflowError(f"--config {name}={value}: expected true or false")
    return value == "true"


OVERWRITE = flag("overwrite", False)  # consent to overwrite finished results
GPUS = flag("gpus", True)  # whether jobs request GPUs from a cluster
if config.pop("study", None) and snakemake_internals.configfiles(workflow):
    raise WorkflowError("--config study=... and --configfile: expected one of them")
PLAN = config.pop("plan", None)  # file to which a dry run writes its jobs

try:
    own = [] if snakemake_internals.is_module(workflow) else FILES  # a module uses the configuration passed to it
    for path in own:
        loading.read(path)  # check the file, since Snakemake takes the last of two equal keys
    STUDY = loading.parse(config, own)
    POINTS = loading.at_points(STUDY)  # several if there is a sweep
except StudyError as error:
    raise WorkflowError(str(error)) from None


@cache
def study_named(name):
    """Return the study of this name: that of the configuration, one in a folder of studies, a point or a part of these."""
    studies = {study.name: study for study in (STUDY, *POINTS)}
    if name not in studies:
        whole = studies.get(whole_study_name(name)) or study_in_folder(name.partition("/")[0])
        studies |= {study.name: study for study in (whole, *loading.at_points(whole), *parts(whole))}
    if name not in studies:
        raise StudyError(f"{name}: no such study; expected one of {', '.join(studies)}")
    return studies[name]


def study_in_folder(name):
    """Read the study of this name from a folder of studies."""
    path = loading.file_of(name)
    study = loading.load(path)
    if study.name != name:
        raise StudyError(f"{path}: name = {study.name}: expected {path.stem}, as in results/{name}")
    return study


def study_of(wildcards):
    """Return the study of a job."""
    return study_named(wildcards.get("study", STUDY.name))


def whole_study_of(wildcards):
    """Return the study whose lenses and networks a job uses; a part of a study has only tables of its own."""
    return study_named(whole_study_name(study_of(wildcards).name))


@cache
def durations_in(study):
    """Return the measured durations of a study by its name."""
    return durations_of(study_named(study))


def contents(of, wildcards):
    """Return what `of` returns for the study and, by their names, the wildcards of a job."""
    names_of_wildcards = list(signature(of).parameters)[1:]
    values = {name: int(wildcards[name]) if name == "seed" else wildcards[name] for name in names_of_wildcards}
    return of(study_of(wildcards), **values)


def settings(of):
    """Return a function from wildcards to the settings of a job as JSON; for `of`, see `contents`."""
    return lambda w: contents(of, w).model_dump_json()


def named(**values):
    """Return such a function for settings that are parameters of the job, each by a function of study and wildcards."""
    return lambda w: to_json({name: contents(value, w) for name, value in values.items()}).decode()


def files_of(pattern, of, keys="lens_keys"):
    """Return a function from wildcards to the files of a pattern for all keys of a job's settings; `of` as above."""
    return lambda w: paths_of(pattern, whole_study_of(w), getattr(contents(of, w), keys))


def call(function):
    """Return the parameters with the name of a library function and the digest of its code; a new digest reruns jobs."""
    return {"function": function, "code": code_digest(function)}


def needs(rule, gpu=0):
    """Return memory, time limit and GPUs of the jobs of a rule; memory and time double after a failure."""
    return {
        "mem_mb": lambda w, attempt: attempt * durations_in(w.get("study", STUDY.name)).memory_mb(rule),
        "runtime": lambda w, attempt: attempt * durations_in(w.get("study", STUDY.name)).limit_minutes(rule),
        "gpu": gpu if GPUS else 0,
    }


def path_of(pattern, study, **wildcards):
    """Return the path of a pattern such as `rules.images.output.train`, of a study."""
    return pattern.format(study=study.name, **wildcards)


def paths_of(pattern, study, keys):
    """Return the paths of a pattern such as `rules.design.output.lens`, of a study, one for each key."""
    return [path_of(pattern, study, **key._asdict()) for key in keys]


def report_output(path, caption, category="Tables", **labels):
    """Return an output that Snakemake's report shows with a caption from `workflow/report`."""
    labels = {"study": "{study}"} | labels
    return report(path, caption=f"../report/{caption}.rst", category=category, labels=labels)


@cache
def lenses_of_table1(name):
    """Return the lenses in table 1 of a study, and the sharp images, each with the number of its element count."""
    study = study_named(name)
    order = {elements: number for number, elements in enumerate(study.elements)}
    lenses = table_contents.table(study, "table1").lenses if "table1" in study.tables else ()
    return {names.SHARP: 0} | {lens: order.get(study.lens(lens).elements, len(order)) for lens in lenses}


def early(rank=0):
    """Return a priority: jobs of table 1 of the first element counts come first, and among them those of greater rank."""

    def priority(wildcards):
        study = whole_study_of(wildcards)
        first = len(study.elements) + rank
        if study.name != wildcards.get("study", STUDY.name):  # a part
            return first
        if {wildcards.get(name, study.supervisor) for name in ("classifier", "measured_name")} != {study.supervisor}:
            return rank
        if "lens" not in wildcards.keys():
            return first
        lenses = lenses_of_table1(study.name)
        return first - lenses[wildcards.lens] if wildcards.lens in lenses else rank

    return priority


def page_priority(wildcards):
    """Return the priority of a page: that of a part is early; that of a study is last, to show tables that are ready."""
    return early()(wildcards) if wildcards.study != whole_study_name(wildcards.study) else -1


wildcard_constraints:
    study=r"[a-z0-9_]+(/[\w.]+=[\w.=+-]+)?",
    lens=rf"[a-z0-9_]+-[a-z0-9_]+|{names.SHARP}",
    classifier="[a-z0-9_]+",
    measured_name="[a-z0-9_]+(-restored)?",
    task="[a-z0-9_]+",
    seed=r"\d+",
    table="table[1-4]",
    elements="[a-z0-9_]+",
    ablation="[a-z0-9_]+",
