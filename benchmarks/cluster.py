"""A study of a thousand lenses on a cluster: planning it, and a simulation of its run over the graph of its jobs.

The plan is `snakemake -n tables` of the paper's study with many seeds, in a separate process; the targets are 60 s and
1 GB. The simulation schedules the same jobs by a list: a free GPU takes the job of the highest priority; among equals,
the one declared first. Durations of jobs with networks are computed (cost.py, an A100), images are read at an assumed
rate, and all other jobs last as long as in the study `small` (config/durations.csv). The durations omit starting a job,
its queue, rays and captures. A job fails at a random time, and resumes from its checkpoint or restarts.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil
import timing
from job_graph import graph
from scheduling import chains, critical_path, simulate

from tasklens.pipeline.changes import PlannedJob
from tasklens.pipeline.digest import ROOT
from tasklens.study import loading


def planned(study: str, seeds: Sequence[int]) -> tuple[list[PlannedJob], float, float, float]:
    """Jobs, wall and processor time [s] and peak memory [GB] of Snakemake's dry run."""
    words = ["-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--cores", "1", "-n", "tables"]
    words += ["--configfile", str(Path(study).resolve()), "--config", f"seeds={list(seeds)}", "plan=jobs.json"]
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as log:
        begin, peak = time.monotonic(), 0
        process = psutil.Popen([sys.executable, *words], cwd=folder, stdout=log, stderr=subprocess.STDOUT)
        ended = 0, 0, None
        while not ended[0]:  # sampled, because Linux's final value includes this process
            peak = max(peak, process.memory_info().rss)
            time.sleep(0.05)
            ended = os.wait4(process.pid, os.WNOHANG)
        wall = time.monotonic() - begin
        log.seek(0)
        assert not ended[1], log.read()
        jobs = [PlannedJob(**row) for row in json.loads(Path(folder, "jobs.json").read_text())]
    return jobs, wall, ended[2].ru_utime + ended[2].ru_stime, peak / 1e9


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("study", nargs="?", default="config/imagenet.yaml", help="a study file")
    parser.add_argument("--seeds", type=int, default=28, help="with the paper's 36 lenses 1008 designs")
    parser.add_argument("--gpus", type=int, default=100)
    parser.add_argument("--failing", type=float, default=0.01, help="probability that an attempt fails")
    options = parser.parse_args(arguments)
    seeds, gpus, trials = (1, 4, 2) if options.tiny else (options.seeds, options.gpus, 20)
    jobs, *figures = planned(options.study, range(seeds))
    title, columns = f"Planning {options.study}, {seeds} seeds", ("jobs", "time [s]", "processor time [s]", "peak [GB]")
    timing.report(title, columns, [(len(jobs), *(f"{value:.3g}" for value in figures))], options.save)

    all_jobs = graph(loading.load(options.study).model_copy(update={"seeds": tuple(range(seeds))}), jobs)
    lengths, path = chains(all_jobs), critical_path(all_jobs)
    longest, work = lengths[path[0]], sum(job.hours * job.gpus for job in all_jobs.values())
    ranks = {"priorities": lambda name: -all_jobs[name].priority, "longest chain first": lambda name: -lengths[name]}
    rows = []
    for case, rank, failing, resumed in (
        ("no failures", "priorities", 0.0, True),
        ("no failures", "longest chain first", 0.0, True),
        (f"{100 * options.failing:g} % fail, from the checkpoint", "priorities", options.failing, True),
        (f"{100 * options.failing:g} % fail, from the beginning", "priorities", options.failing, False),
    ):
        runs = [simulate(all_jobs, gpus, ranks[rank], failing, resumed, seed) for seed in range(trials)]
        over = statistics.median(run.hours for run in runs) / max(longest, work / gpus)
        useful = 100 * statistics.median(work / run.hours / gpus for run in runs)
        again = 100 * (statistics.median(run.busy for run in runs) / work - 1)
        numbers = timing.spread([run.hours for run in runs]), f"{over:.3f}", f"{useful:.1f}", f"{again:.2f}"
        failures, given_up = (statistics.mean(getattr(r, name) for r in runs) for name in ("failures", "given_up"))
        rows.append((case, rank, *numbers, f"{failures:.3g}", f"{given_up:.3g}"))
    columns = (
        "run",
        "order",
        "hours",
        "over the least",
        "useful work [%]",
        "repeated work [%]",
        "failures",
        "given up",
    )
    timing.report(f"{len(all_jobs)} jobs on {gpus} GPUs", columns, rows, options.save)

    rows = [(name, f"{all_jobs[name].hours:.3g}") for name in path if all_jobs[name].hours > 0.01 * longest]
    rows += [("longest chain", f"{longest:.3g}"), (f"all work over {gpus} GPUs", f"{work / gpus:.3g}")]
    timing.report("What limits", ("job of the longest chain", "hours"), rows, options.save)


if __name__ == "__main__":
    main()
