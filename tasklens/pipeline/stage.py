"""Stages and the plans of their jobs.

A stage is one kind of job, such as the design of a lens. It is declared once, in `pipeline.jobs`,
`pipeline.figure_jobs` or `pipeline.report_jobs`, by the function that does the work, the paths of its outputs, and a
function that returns the settings and inputs of each job. Snakemake's rules, the command line and the keys of
checkpoints are made from that declaration.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tasklens.study.settings import Frozen
from tasklens.study.study import Study

SEED = "seed"  # the wildcard that is a number, and an option of the command line


def results(study: Study) -> str:
    """Return the folder of all files that a study writes."""
    return f"results/{study.name}"


def study_file(study: Study) -> str:
    """Return the file of a study with all defaults, which its jobs read."""
    return f"{results(study)}/study.yaml"


def flatten(files: Any) -> Iterator[Path]:
    """Yield all paths in nested mappings and sequences; None means no file."""
    if isinstance(files, Path):
        yield files
    elif files is not None:
        for value in files.values() if isinstance(files, Mapping) else files:
            yield from flatten(value)


@dataclass(frozen=True)
class Plan:
    """Declaration of one job.

    Attributes:
        settings: slice of the study that the job may read; Snakemake compares it, so that a changed value reruns only
            the jobs that read it.
        inputs: files by name: a path, a mapping or sequence of paths, or None.
        processes: size of the process group.
        gpus: number of GPUs that the job uses, if there are any.
    """

    settings: Frozen
    inputs: Mapping[str, Any] = field(default_factory=dict)
    processes: int = 1
    gpus: int = 0


@dataclass(frozen=True)
class Stage:
    """A kind of job.

    Attributes:
        plan: function from study and wildcards to the plan of a job; it gives the stage its name and wildcards.
        function: `package.module.function` with settings, inputs and outputs as arguments, which does the work.
        patterns: path of each output below the results folder, with wildcards in braces; or a function that returns
            them for a study, empty if the study has no such jobs.
        resumable: whether the function takes a checkpoint, so that a killed job is resumed.
        threads: number of threads per process for Snakemake.
        priority: Snakemake's priority of its jobs.
    """

    plan: Callable[..., Plan]
    function: str
    patterns: Mapping[str, str] | Callable[[Study], Mapping[str, str]]
    resumable: bool
    threads: int
    priority: int

    @property
    def name(self) -> str:
        """Name of the stage, its rule and its command."""
        return self.plan.__name__

    @property
    def wildcards(self) -> tuple[str, ...]:
        """Names of the wildcards of its paths."""
        return tuple(inspect.signature(self.plan).parameters)[1:]

    @property
    def label(self) -> str:
        """Pattern of a job's name, such as `design/{lens}-seed{seed}`; without wildcards the name of the stage."""
        parts = (f"seed{{{name}}}" if name == SEED else f"{{{name}}}" for name in self.wildcards)
        return f"{self.name}/{'-'.join(parts)}" if self.wildcards else self.name

    def plan_from(self, study: Study, wildcards: Mapping[str, str]) -> Plan:
        """Return the plan of a job, from wildcards as texts."""
        return self.plan(study, **{n: int(wildcards[n]) if n == SEED else wildcards[n] for n in self.wildcards})

    def command(self, study: Study, wildcards: Mapping[str, str]) -> str:
        """Return the command that a person would type for a job of the resolved study."""
        processes = self.plan_from(study, wildcards).processes
        # Snakemake sets the threads of a job to its cores, here those of all its processes.
        torchrun = f"OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node {processes} -m tasklens.cli"
        words = [f"--seed {wildcards[name]}" if name == SEED else wildcards[name] for name in self.wildcards]
        return " ".join(
            ["tasklens" if processes == 1 else torchrun, "run", self.name.replace("_", "-"), study_file(study), *words]
        )

    def patterns_in(self, study: Study) -> Mapping[str, str]:
        """Return the patterns of the outputs in a study."""
        return self.patterns(study) if callable(self.patterns) else self.patterns

    def outputs(self, study: Study, **wildcards: str | int) -> dict[str, Path]:
        """Return the paths of a job's outputs by name; without wildcards their patterns, for Snakemake."""
        return {name: self.output(study, name, **wildcards) for name in self.patterns_in(study)}

    def benchmark(self, study: Study) -> str:
        """Return the pattern of the files in which Snakemake writes the time and memory of the jobs."""
        return f"{results(study)}/benchmarks/{self.label}.tsv"

    def output(self, study: Study, name: str, **wildcards: str | int) -> Path:
        """Return the path of the output `name` of a job; without wildcards its pattern."""
        pattern = self.patterns_in(study)[name]
        return Path(results(study), pattern.format(**wildcards) if wildcards else pattern)


STAGES: dict[str, Stage] = {}  # by name, in the order of their declaration


def stage(
    function: str,
    patterns: Mapping[str, str] | Callable[[Study], Mapping[str, str]],
    resumable: bool = False,
    threads: int = 1,
    priority: int = 0,
) -> Callable[[Callable[..., Plan]], Stage]:
    """Declare a stage by the function that plans its jobs; the arguments are attributes of `Stage`."""

    def declare(plan: Callable[..., Plan]) -> Stage:
        if plan.__name__ in STAGES:
            raise ValueError(f"stage {plan.__name__}: declared twice")
        STAGES[plan.__name__] = Stage(plan, function, patterns, resumable, threads, priority)
        return STAGES[plan.__name__]

    return declare
