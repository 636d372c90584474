"""Workflow of a study: `snakemake -j2 tables`; another study with `--configfile config/smoke.yaml`."""

import ast
import json
import os
import shlex
import sys
from functools import cache
from pathlib import Path
from subprocess import CalledProcessError

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger
from snakemake.settings.types import ExecMode
from snakemake.utils import min_version

from tasklens.pipeline import changes, closing, jobs, kept_studies, figure_jobs, report_jobs, runs
from tasklens.pipeline.digest import code_digest
from tasklens.pipeline.forecast import durations_of
from tasklens.pipeline.stage import STAGES, flatten, results, study_file
from tasklens.pipeline.terminal import Terminal, after_dry_run
from tasklens.recognition import class_folders
from tasklens.runtime import files
from tasklens.runtime.errors import InputError
from tasklens.study import claims, loading, names
from tasklens.study.study import TABLES, StudyError

min_version("9.10")

if not workflow.config_settings.configfiles:

    configfile: "config/config.yaml"


def flag(name, default):
    """Take a key that is of a run, no part of the study, out of the configuration; `--config` gives texts."""
    given = str(config.pop(name, default)).lower()
    if given not in ("true", "false"):
        raise WorkflowError(f"--config {name}={given}: expected true or false")
    return given == "true"


overwrite = flag("overwrite", False)  # consent
gpus = flag("gpus", True)  # whether a cluster has some to ask for
try:
    for path in workflow.config_settings.configfiles:
        loading.read(path)  # Snakemake takes the last of two equal keys
    given = loading.parse(config, [Path(path) for path in workflow.config_settings.configfiles])
    studies = loading.at_points(given)  # more than one of a sweep
except StudyError as error:
    raise WorkflowError(str(error)) from None

EVERY = {study.name: study for study in [given, *studies]}
durations = {name: durations_of(study) for name, study in EVERY.items()}

# `tasklens` is that of the Python that runs Snakemake, even if its environment is not activated.
# Freed memory stays with the process, since page faults of new arrays otherwise take a fifth of the time of a training
# with images of 64 pixels, and half of that of an evaluation with 224.
shell.prefix(
    f"export PATH={shlex.quote(os.path.dirname(sys.executable))}:$PATH"
    " MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=2147483647; "
)


wildcard_constraints:
    lens="|".join(dict.fromkeys(lens for study in studies for lens in (*study.lenses, *study.variants, names.SHARP))),
    classifier="|".join(given.classifiers),
    measured_name="|".join([*given.classifiers, *map(names.restored, given.classifiers)]),
    seed="|".join(map(str, given.seeds)),
    table="|".join(TABLES),
    elements="|".join(given.elements),
    ablation="|".join(given.ablations),
    task="|".join(given.tasks.networks),


def targets_of(study):
    """Return the targets of the command line with the files of a study; the first is the default."""
    tables = {name: [report_jobs.table.output(study, "csv", table=name)] for name in TABLES}
    ablations = {
        f"ablation_{name}": [report_jobs.ablation.output(study, "csv", ablation=name)] for name in study.ablations
    }
    lenses = [{"lens": lens, "seed": seed} for lens in study.lenses for seed in study.seeds]
    compared = [{"elements": name, "seed": seed} for name in claims.claims_by_elements(study) for seed in study.seeds]
    return {
        "tables": [
            *sum((tables[name] for name in study.tables), []),
            report_jobs.verdicts.output(study, "csv"),
            report_jobs.psf_tail.output(study, "csv"),
            report_jobs.effort.output(study, "csv"),
            report_jobs.report.output(study, "report"),
        ],
        **tables,
        "backbones": tables["table2"],  # the single ablations of the paper's section 5
        "end_to_end": tables["table3"],
        "restoration": tables["table4"],
        "figures": [figure_jobs.certificate.output(study, "figure", **lens) for lens in lenses],
        "figure3": [figure_jobs.comparison.output(study, "figure", **each) for each in compared],
        "figure4": [figure_jobs.frames.output(study, "figure", **each) for each in compared],
        "certificates": [figure_jobs.certificate.output(study, "page", **lens) for lens in lenses],
        "ablations": sum(ablations.values(), []),
        **ablations,
    }


TARGETS = {}
for study in studies:
    for target, paths in targets_of(study).items():
        TARGETS.setdefault(target, []).extend(paths)
if given.sweep:  # of which stages are named by point
    TARGETS["tables"].append(report_jobs.sweep.output(given, "csv"))
    for stage in (report_jobs.verdicts, report_jobs.psf_tail, report_jobs.effort, report_jobs.report):
        TARGETS[stage.name] = [next(iter(stage.outputs(study).values())) for study in studies]
    for stage in (report_jobs.regimes, report_jobs.merit_function, report_jobs.tolerances, report_jobs.tasks):
        TARGETS[stage.name] = [stage.outputs(study)["csv"] for study in studies if stage.outputs(study)]

for target, paths in TARGETS.items():

    rule:
        name:
            target
        input:
            paths,
        localrule: True


include: "workflow/rules/jobs.smk"


def at_once():
    """Return how many jobs run at once: on cores of this machine, or submitted to a cluster."""
    return workflow.resource_settings.cores or workflow.resource_settings.nodes or 1


def has_output(job):
    """Return whether any output of a job is there, and not that of a killed job."""
    halves = workflow.async_run(workflow.persistence.incomplete(job))
    return any(os.path.exists(path) for path in job.output if path not in halves)


def made_with(job):
    """Return the settings with which the outputs of a job were made, as Snakemake has recorded them; else None."""
    recorded = (ast.literal_eval(text) for path in job.output for text in workflow.persistence.params(path) or ())
    return next((json.loads(text) for text in recorded if isinstance(text, str) and text.startswith("{")), None)


def planned_jobs():
    """Return the jobs of this run by label, of each study."""
    planned = {name: {} for name in EVERY}
    for job in workflow.dag.needrun_jobs(exclude_finished=False):  # a dry run counts all as finished
        if job.rule.name in RULES:
            study, stage = RULES[job.rule.name]
            label = lambda job: runs.label_of(job.log, results(study))
            needs = (other for other in workflow.dag.dependencies[job] if other.rule.name in RULES)
            planned[study.name][label(job)] = changes.PlannedJob(
                stage.name, job.wildcards_dict, has_output(job), tuple(map(label, needs)), made_with(job)
            )
    return {name: found for name, found in planned.items() if found}


def overwritten(planned):
    """Return the finished results that the planned jobs of each study overwrite."""
    return {name: changes.overwritten(Path(study_file(EVERY[name])), EVERY[name], planned[name]) for name in planned}


def refusals(found):
    """Return why this run must not start: changed values would overwrite finished results; else an empty text."""
    cores = at_once()
    said = (changes.refusal(each, EVERY[name], durations[name], cores) for name, each in found.items())
    return "" if overwrite else "\n\n".join(filter(None, said))


if workflow.output_settings.dryrun:
    after_dry_run(logger, lambda: refusals(overwritten(planned_jobs())))
elif workflow.exec_mode == ExecMode.DEFAULT:
    terminal = Terminal(EVERY.values(), logger, bool(workflow.output_settings.quiet))


def prepare(planned):
    """Check what the planned jobs read, and write the files of the studies for them; ends the run if it cannot be."""
    kinds = {job.stage for jobs_of_study in planned.values() for job in jobs_of_study.values()}
    if "images" in kinds:
        try:
            for study in studies:
                class_folders.check(study.images)
        except InputError as error:
            sys.exit(f"{error}")
    kept = {name: kept_studies.keep(study) for name, study in EVERY.items()}  # of these, jobs take their settings
    networks = "--networks" if kinds & {"reference", "task_reference"} else ""
    if networks or given.imported or "design" in kinds:  # those that design trace rays: compiled before, it is once
        try:
            shell(f"tasklens study check {kept[given.name]} --no-weights {networks} > /dev/null")
        except CalledProcessError as error:  # which has said why
            sys.exit(error.returncode)
    for study in EVERY.values():  # for people, and the next run
        files.write_if_changed(study_file(study), loading.dump(study))


onstart:
    planned, cores = planned_jobs(), at_once()
    found = overwritten(planned)
    if reason := refusals(found):
        sys.exit(reason)
    prepare(planned)
    for name, jobs_of_study in planned.items():
        if found[name].otherwise:
            amount = changes.amount(found[name].otherwise, EVERY[name], durations[name], cores)
            print(f"Changed code or input files, or added classifiers: {amount}")
        print(durations[name].forecast([job.stage for job in jobs_of_study.values()], cores))
    terminal.begin(planned, cores)


onsuccess:
    terminal.end()
    print(closing.success(given, terminal.runs))


onerror:
    terminal.end()
    print(closing.failure(given, terminal.runs))
