"""Workflow of a study: `snakemake -j2 tables`; another study with `--config study=smoke`, or `--configfile FILE`."""

from snakemake.utils import min_version

from tasklens.study.run import snakemake_internals
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


rule tables:
    """All tables of the study, their verdicts, and the page."""
    default_target: True  # here, because Snakemake forgets that of an included file
    input:
        [path_of(rules.table.output.csv, s, table=table.name) for s in POINTS for table in table_contents.tables(s)],
        at_points(rules.verdicts_table.output.csv),
        at_points(rules.psf_tail_table.output.csv),
        at_points(rules.effort_table.output.csv),
        at_points(rules.report_page.output.report),
        lambda _: [path_of(rules.report_page.output.report, part) for part in parts(STUDY)],
        path_of(rules.sweep_table.output.csv, STUDY) if STUDY.sweep else [],
