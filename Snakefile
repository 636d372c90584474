"""Workflow of a study: `snakemake -j2 tables`; another study with `--configfile config/smoke.yaml`."""

import os
import shlex
import sys
from functools import cache

from snakemake.exceptions import WorkflowError
from snakemake.utils import min_version

from tasklens.pipeline import jobs, report_jobs
from tasklens.pipeline.digest import code_digest
from tasklens.pipeline.forecast import Durations
from tasklens.pipeline.stage import STAGES, flatten, results
from tasklens.runtime import files
from tasklens.study import claims, loading, names
from tasklens.study import study as studies

min_version("9.10")

if not workflow.config_settings.configfiles:

    configfile: "config/config.yaml"


try:
    study = loading.parse(config)
except studies.StudyError as error:
    raise WorkflowError(str(error)) from None

RESOLVED = f"{results(study)}/study.yaml"  # the study with all defaults, read by jobs
durations = Durations(study.name, results(study))
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


if jobs.others(study):  # `tasklens fine-tune` makes one of these by hand

    ruleorder: fine_tune_others > fine_tune


shown = []  # the tables of this run, printed at its end


onstart:
    # Not written while parsing: a dry run during a running study must not change the file that its jobs read.
    files.write_if_changed(RESOLVED, loading.dump(study))
    running = list(workflow.dag.needrun_jobs())
    kinds = {job.rule.name for job in running}
    networks = "--networks" if "reference" in kinds else ""
    if networks or study.imported or "design" in kinds:  # those that design trace rays: compiled before, it is once
        shell("tasklens check {RESOLVED} {networks} > /dev/null")
    found = {path for job in running for path in job.output if path.startswith(f"{results(study)}/tables/")}
    if any(job.rule.name == "verify" for job in running):  # it prints the verdicts itself
        found.discard(str(report_jobs.verdicts.output(study, "md")))
    shown.extend(sorted(path for path in found if path.endswith(".md")))
    print(durations.forecast([job.rule.name for job in running if job.rule.name in STAGES], workflow.cores or 1))


onsuccess:
    for path in shown:
        print(open(path, encoding="utf-8").read())


onerror:
    print(f"Tables of what has finished: tasklens table {RESOLVED} {study.tables[0]} --partial")
