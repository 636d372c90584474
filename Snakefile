"""The study as a workflow: `snakemake -j2 tables`; another study with `--configfile config/smoke.yaml`."""

import os
import shlex
import sys

from snakemake.exceptions import WorkflowError
from snakemake.utils import min_version

from tasklens.study import claims
from tasklens.runtime import files
from tasklens.pipeline import jobs
from tasklens.study import study as studies
from tasklens.pipeline.digest import code, of_folder
from tasklens.pipeline.layout import PAPER, SHARP, Layout, restored
from tasklens.study.design_settings import Outside

min_version("9.10")

if not workflow.config_settings.configfiles:

    configfile: "config/config.yaml"


try:
    study = studies.parse(config)
except studies.StudyError as error:
    raise WorkflowError(str(error)) from None

layout = Layout.of(study)
# `tasklens` is that of the Python that runs Snakemake, also where its environment is not activated.
# What a job frees stays with it: given back to the system, every page of the next array would be faulted in again, a fifth
# of a training's time with pictures of 64 pixels, half of an evaluation's with 224.
shell.prefix(
    f"export PATH={shlex.quote(os.path.dirname(sys.executable))}:$PATH"
    " MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=2147483647; "
)


wildcard_constraints:
    lens="|".join([*study.lenses, *study.variants, SHARP]),
    classifier="|".join(study.classifiers),
    seed="|".join(map(str, study.seeds)),
    table="|".join(studies.TABLES),
    elements="|".join(study.elements),
    ablation="|".join(study.ablations),


localrules:
    tables,
    backbones,
    end_to_end,
    restoration,
    figures,
    figure3,
    certificates,
    ablations,


rule tables:
    input:
        [layout.table(name, "csv") for name in (*study.tables, "verdicts", "psf_tail")],


rule backbones:
    input:
        layout.table("table2", "csv"),


rule end_to_end:
    input:
        layout.table("table3", "csv"),


rule restoration:
    input:
        layout.table("table4", "csv"),


rule figures:
    input:
        [layout.figure(lens, seed) for lens in study.lenses for seed in study.seeds],


rule figure3:
    input:
        [
            layout.comparison(claim.lens.partition("-")[0], seed)
            for claim in claims.regimes(study).claims
            for seed in study.seeds
        ],


rule certificates:
    input:
        [layout.certificate(lens, seed) for lens in study.lenses for seed in study.seeds],


rule ablations:
    input:
        [layout.ablation(name, "csv") for name in study.ablations],


for name in study.ablations:

    rule:
        name:
            f"ablation_{name}"
        input:
            layout.ablation(name, "csv"),
        localrule: True


for name in studies.TABLES:

    rule:
        name:
            name
        input:
            layout.table(name, "csv"),
        localrule: True


include: "workflow/rules/inputs.smk"
include: "workflow/rules/data.smk"
include: "workflow/rules/design.smk"
include: "workflow/rules/psf.smk"
include: "workflow/rules/classify.smk"
include: "workflow/rules/restore.smk"
include: "workflow/rules/report.smk"
include: "workflow/rules/verify.smk"


made = []  # the tables of this run, shown at its end


onstart:
    # Here and not while parsing: a dry run beside a running study must not change what its jobs read.
    files.write_if_changed(layout.study, studies.dump(study))
    running = list(workflow.dag.needrun_jobs())
    networks = "--networks" if any(job.rule.name == "reference" for job in running) else ""
    if networks or study.outside:
        shell("tasklens check {layout.study} {networks} > /dev/null")
    shown = [path for job in running for path in job.output if path.startswith(f"{layout.root}/tables/")]
    shown = [path for path in shown if path.endswith(".md")]
    if any(job.rule.name == "verify" for job in running):  # it prints the verdicts itself
        shown = [path for path in shown if path != layout.table("verdicts", "md")]
    made.extend(sorted(shown))
    planned = [job for job in running if job.rule.name in study.minutes]
    total = sum(study.minutes[job.rule.name] for job in planned)
    cores = workflow.cores or 1  # a cluster has none
    print(f"Study {study.name}: {len(planned)} jobs, about {total / cores:.0f} minutes on {cores} cores.")


onsuccess:
    for path in made:
        print(open(path).read())


onerror:
    print(f"Tables of what has finished: tasklens table {layout.study} table1 --partial")
