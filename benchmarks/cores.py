"""Time of a finished study on several cores: list scheduling of its jobs with their measured durations.

    python benchmarks/cores.py results/small

A free core takes the ready job with the longest chain of jobs behind it. Not simulated: jobs slow each other down on
shared memory, which the measured durations contain for the number of cores that the study ran on.
"""

from pathlib import Path

import timing
from cluster import planned
from scheduling import Job, chains, critical_path, simulate

from tasklens.runtime import benchmarks
from tasklens.study import loading
from tasklens.study.parts import whole_study_name

CORES = (1, 2, 4, 8)


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("results", type=Path, help="folder of a finished study")
    options = parser.parse_args(arguments)
    study = options.results / "study.yaml"
    seeds = loading.load(study).seeds
    jobs = {}
    for job in (job for job in planned(str(study), seeds)[0] if job.study == whole_study_name(job.study)):
        path = options.results / "benchmarks" / f"{job.label}.tsv"
        if (measured := benchmarks.read(path)) is None:
            parser.error(f"{path}: no measured time; the study has not finished")
        jobs[job.label] = Job(job.rule, measured.seconds / 3600, 1, 0, frozenset(job.needs))
    lengths, rows = chains(jobs), []
    path = critical_path(jobs)
    for cores in CORES:
        run = simulate(jobs, cores, lambda name: -lengths[name])
        at_work = run.busy / run.hours
        rows.append((cores, f"{60 * run.hours:.1f}", f"{at_work:.2f}", f"{100 * at_work / cores:.0f}"))
    columns = ("cores", "minutes", "times faster than one core", "cores at work [%]")
    timing.report(f"{options.results.name}: {len(jobs)} jobs", columns, rows, options.save)
    hours = sum(jobs[name].hours for name in path)
    print(f"Critical path, {60 * hours:.1f} minutes: {', '.join(path)}")


if __name__ == "__main__":
    main()
