"""Workflow of a study: `snakemake -j2 tables`; another study with `--configfile config/smoke.yaml`."""

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

from tasklens.pipeline import changes, closing, jobs, report_jobs, runs
from tasklens.pipeline.digest import code_digest
from tasklens.pipeline.forecast import durations_of
from tasklens.pipeline.stage import STAGES, flatten, results
from tasklens.pipeline.terminal import Terminal, after_dry_run
from tasklens.recognition import class_folders
from tasklens.runtime import files
from tasklens.runtime.errors import InputError
from tasklens.study import claims, loading, names
from tasklens.study import study as studies

min_version("9.10")

if not workflow.config_settings.configfiles:

    configfile: "config/config.yaml"


overwrite = config.pop("overwrite", False)  # consent, no part of the study
try:
    study = loading.parse(config, [Path(path) for path in workflow.config_settings.configfiles])
except studies.StudyError as error:
    raise WorkflowError(str(error)) from None

RESOLVED = f"{results(study)}/study.yaml"  # the study with all defaults, read by jobs
durations = durations_of(study)
LENSES = [{"lens": lens, "seed": seed} for lens in study.lenses for seed in study.seeds]

# `tasklens` is that of the Python that runs Snakemake, even if its environment is not activated.
# Freed memory stays with the process, since page faults of new arrays otherwise take a fifth of the time of a training
# with images of 64 pixels, and half of that of an evaluation with 224.
shell.prefix(
    f"export PATH={shlex.quote(os.path.dirname(sys.executable))}:$PATH"
    " MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=2147483647; "
)


wildcard_constraints:
    lens="|".join([*study.lenses, *study.variants, names.SHARP]),
    classifier="|".join(study.classifiers),
    measured_name="|".join([*study.classifiers, *map(names.restored, study.classifiers)]),
    seed="|".join(map(str, study.seeds)),
    table="|".join(studies.TABLES),
    elements="|".join(study.elements),
    ablation="|".join(study.ablations),


TABLES = {name: [report_jobs.table.output(study, "csv", table=name)] for name in studies.TABLES}
ABLATIONS = {f"ablation_{name}": [report_jobs.ablation.output(study, "csv", ablation=name)] for name in study.ablations}
TARGETS = {  # targets of the command line; the first is the default
    "tables": [
        *sum((TABLES[name] for name in study.tables), []),
        report_jobs.verdicts.output(study, "csv"),
        report_jobs.psf_tail.output(study, "csv"),
        report_jobs.effort.output(study, "csv"),
        report_jobs.report.output(study, "report"),
    ],
    **TABLES,
    "backbones": TABLES["table2"],  # the single ablations of the paper's section 5
    "end_to_end": TABLES["table3"],
    "restoration": TABLES["table4"],
    "figures": [report_jobs.certificate.output(study, "figure", **lens) for lens in LENSES],
    "figure3": [
        report_jobs.comparison.output(study, "figure", elements=elements, seed=seed)
        for elements in claims.claims_by_elements(study)
        for seed in study.seeds
    ],
    "figure4": [
        report_jobs.frames.output(study, "figure", elements=elements, seed=seed)
        for elements in claims.claims_by_elements(study)
        for seed in study.seeds
    ],
    "certificates": [report_jobs.certificate.output(study, "page", **lens) for lens in LENSES],
    "ablations": sum(ABLATIONS.values(), []),
    **ABLATIONS,
}

for target, paths in TARGETS.items():

    rule:
        name:
            target
        input:
            paths,
        localrule: True


include: "workflow/rules/jobs.smk"


if jobs.others(study):  # `tasklens run fine-tune` makes one of these by hand

    ruleorder: fine_tune_others > fine_tune


def has_output(job):
    """Return whether any output of a job is there, and not that of a killed job."""
    halves = workflow.async_run(workflow.persistence.incomplete(job))
    return any(os.path.exists(path) for path in job.output if path not in halves)


def planned_jobs():
    """Return the jobs of this run by label."""
    label = lambda job: runs.label_of(job.log, results(study))
    return {
        label(job): changes.PlannedJob(
            job.rule.name,
            job.wildcards_dict,
            has_output(job),
            tuple(label(other) for other in workflow.dag.dependencies[job] if other.rule.name in STAGES),
        )
        for job in workflow.dag.needrun_jobs(exclude_finished=False)  # a dry run counts all as finished
        if job.rule.name in STAGES
    }


def refusal(found):
    """Return why this run must not start: changed values would overwrite finished results; else None."""
    return None if overwrite else changes.refusal(found, study, durations, workflow.cores or 1)


if workflow.output_settings.dryrun:
    after_dry_run(logger, lambda: refusal(changes.overwritten(Path(RESOLVED), study, planned_jobs())))
elif workflow.exec_mode == ExecMode.DEFAULT:
    terminal = Terminal(study, logger, bool(workflow.output_settings.quiet))


onstart:
    planned, cores = planned_jobs(), workflow.cores or 1
    kinds = {job.stage for job in planned.values()}
    found = changes.overwritten(Path(RESOLVED), study, planned)
    if reason := refusal(found):
        sys.exit(reason)
    if "images" in kinds:
        try:
            class_folders.check(study.images)
        except InputError as error:
            sys.exit(f"{error}")
    # Not written while parsing: a dry run during a running study must not change the file that its jobs read.
    files.write_if_changed(RESOLVED, loading.dump(study))
    networks = "--networks" if "reference" in kinds else ""
    if networks or study.imported or "design" in kinds:  # those that design trace rays: compiled before, it is once
        try:
            shell("tasklens study check {RESOLVED} --no-weights {networks} > /dev/null")
        except CalledProcessError as error:  # which has said why
            sys.exit(error.returncode)
    if found.otherwise:
        again = changes.amount(found.otherwise, study, durations, cores)
        print(f"Changed code or input files, or added classifiers: {again}")
    print(durations.forecast([job.stage for job in planned.values()], cores))
    terminal.begin({name: job.stage for name, job in planned.items()}, cores)


onsuccess:
    terminal.end()
    print(closing.success(study, terminal.run))


onerror:
    terminal.end()
    print(closing.failure(study, terminal.run))
