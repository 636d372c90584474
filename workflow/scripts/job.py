"""Call the function of a rule, `params.function`, with the settings and files of the job."""

from pathlib import Path

from tasklens.runtime.job import run, run_program

arguments = (
    snakemake.params.function,
    snakemake.params.settings,
    snakemake.params.code,
    dict(snakemake.input.items()) | dict(snakemake.params.get("unawaited", {})),
    dict(snakemake.output.items()),
    Path(snakemake.log[0]),
)
run_program(lambda: run(*arguments), Path(snakemake.log[0]))
