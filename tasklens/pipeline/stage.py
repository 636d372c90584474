"""What a stage and a job are.

A stage is one kind of work, such as the design of a lens. It is declared once, in `pipeline.jobs`: the paths of its
outputs, and a function that gives the settings and inputs of each of its jobs. Snakemake's rules, the command line and
the keys of checkpoints are all made from that declaration.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pydantic import ConfigDict

from tasklens.study.settings import Frozen
from tasklens.study.study import Study

SEED = "seed"  # the wildcard that is a number, and an option of the command line


def results(study: Study) -> str:
    """Folder of everything that a study writes."""
    return f"results/{study.name}"


@dataclass(frozen=True)
class Plan:
    """What a stage declares for one job.

    Attributes:
        settings: the slice of the study that the job may read; Snakemake compares it, so that by construction a changed
            value reruns the jobs that read it and no others.
        inputs: files by name: a path, or a mapping or sequence of paths; None where there is none.
        processes: that compute together.
        gpus: that the job takes, where there are any.
    """

    settings: Frozen
    inputs: Mapping[str, Any] = field(default_factory=dict)
    processes: int = 1
    gpus: int = 0


class Slice(Frozen):
    """A part of a study, by names of its own."""

    model_config = ConfigDict(frozen=True, extra="allow")

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


class Files(SimpleNamespace):
    """Input or output files of a job by name: paths, or mappings or sequences of paths."""


def _as_paths(files: Any) -> Any:
    if isinstance(files, str | Path):
        return Path(files)
    if isinstance(files, Mapping):
        return {key: _as_paths(value) for key, value in files.items()}
    return None if files is None else [_as_paths(value) for value in files]


def flatten(files: Any) -> Iterator[str]:
    """All paths in nested mappings and sequences."""
    if isinstance(files, str | Path):
        yield str(files)
    elif files is not None:
        for value in files.values() if isinstance(files, Mapping) else files:
            yield from flatten(value)


@dataclass(frozen=True)
class Job:
    """One job of a stage: what it is called, what it is given and what it leaves."""

    name: str
    settings: Frozen
    inputs: Files
    outputs: Files
    checkpoint: str  # path without the key and the suffix


@dataclass(frozen=True)
class Stage:
    """A kind of job.

    Attributes:
        name: of the stage, and of its rule.
        function: name of the function in `pipeline.stages` that does the work.
        plan: (study, wildcards ..) to the plan of a job; its parameters are the wildcards.
        patterns: path of each output below the results folder, with wildcards in braces.
        resumable: whether a killed job goes on from a checkpoint.
        threads: that Snakemake counts for a job, times its processes.
        priority: of its jobs among those that can run.
    """

    name: str
    function: str
    plan: Callable[..., Plan]
    patterns: Mapping[str, str]
    resumable: bool
    threads: int
    priority: int

    @property
    def wildcards(self) -> tuple[str, ...]:
        """Names of the wildcards of its paths."""
        return tuple(inspect.signature(self.plan).parameters)[1:]

    @property
    def label(self) -> str:
        """Pattern of the name of a job, such as `design/{lens}-seed{seed}`; of the name alone without wildcards."""
        parts = (f"seed{{{name}}}" if name == SEED else f"{{{name}}}" for name in self.wildcards)
        return "/".join([self.name, "-".join(parts)]) if self.wildcards else self.name

    def outputs(self, study: Study, **wildcards: str | int) -> dict[str, str]:
        """Paths of the outputs by name; without wildcards their patterns, as Snakemake wants them."""
        return {name: self._path(study, pattern, wildcards) for name, pattern in self.patterns.items()}

    def output(self, study: Study, name: str, **wildcards: str | int) -> str:
        """Path of the output `name` of a job."""
        return self._path(study, self.patterns[name], wildcards)

    def _path(self, study: Study, pattern: str, wildcards: Mapping[str, str | int]) -> str:
        return f"{results(study)}/{pattern.format(**wildcards) if wildcards else pattern}"

    def job(self, study: Study, **wildcards: str | int) -> Job:
        """The job with these wildcards; raises StudyError for names that the study does not have."""
        plan = self.plan(study, **wildcards)
        label = self.label.format(**wildcards)
        return Job(
            name=label,
            settings=plan.settings,
            inputs=Files(**_as_paths(plan.inputs)),
            outputs=Files(**_as_paths(self.outputs(study, **wildcards))),
            checkpoint=f"{results(study)}/checkpoints/{label.replace('/', '-', 1)}",
        )


STAGES: dict[str, Stage] = {}  # by name, in the order of their declaration


def stage(
    patterns: Mapping[str, str],
    function: str | None = None,
    resumable: bool = False,
    threads: int = 1,
    priority: int = 0,
) -> Callable[[Callable[..., Plan]], Stage]:
    """Declare a stage by the function that plans its jobs; the other arguments are attributes of `Stage`."""

    def declare(plan: Callable[..., Plan]) -> Stage:
        name = plan.__name__
        STAGES[name] = Stage(name, function or name, plan, patterns, resumable, threads, priority)
        return STAGES[name]

    return declare
