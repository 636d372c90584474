"""Workflow of a study: `snakemake -j2 tables`; another study with `--config study=smoke`, or `--configfile FILE`."""

from snakemake.utils import min_version

from tasklens.pipeline import snakemake_internals
from tasklens.study import loading

min_version("9.19")  # priorities that depend on wildcards

FILES = snakemake_internals.configfiles(workflow)
if not FILES:
    FILES = [loading.configfile(config.get("study"))]

    configfile: str(FILES[0])


include: "workflow/rules/common.smk"
include: "workflow/rules/inputs.smk"
include: "workflow/rules/images.smk"
include: "workflow/rules/designs.smk"
include: "workflow/rules/restoration.smk"
include: "workflow/rules/measurements.smk"
include: "workflow/rules/tolerances.smk"
include: "workflow/rules/tasks.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/targets.smk"
include: "workflow/rules/runs.smk"
