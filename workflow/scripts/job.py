"""Call the function of a rule, `params.function`, with the settings and files of the job."""

import sys
from pathlib import Path

from tasklens.runtime.job import run, run_program

group = []
if (processes := snakemake.params.get("processes", 1)) > 1:  # this script again, in each process of a group
    group = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        f"--nproc-per-node={processes}",
        __real_file__,
    ]

arguments = (
    snakemake.params.function,
    snakemake.params.settings,
    snakemake.params.code,
    dict(snakemake.input.items()) | dict(snakemake.params.get("unawaited", {})),
    dict(snakemake.output.items()),
    Path(snakemake.log[0]),
    group,
)
run_program(lambda: run(*arguments), Path(snakemake.log[0]))
