"""Call the function of a rule, `params.function`, with the settings and files of the job."""

import os
import subprocess
import sys
from pathlib import Path

from tasklens.runtime.job import reporting_errors, run

processes = snakemake.params.get("processes", 1)
if processes > 1 and "RANK" not in os.environ:  # this script again, in each process of a group
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), __real_file__]
    with open(snakemake.log[0], "w") as log:
        sys.exit(subprocess.run([sys.executable, *torchrun], stderr=log).returncode)

with reporting_errors(Path(snakemake.log[0])):
    run(
        snakemake.params.function,
        snakemake.params.settings,
        snakemake.params.code,
        dict(snakemake.input.items()) | dict(snakemake.params.get("unawaited", {})),
        dict(snakemake.output.items()),
        Path(snakemake.log[0]),
    )
