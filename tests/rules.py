"""The rules of the workflow in this process: what a job of a study reads, and the job itself."""

import itertools
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from snakemake.api import SnakemakeApi
from snakemake.iocontainers import Wildcards
from snakemake.settings.types import ConfigSettings, OutputSettings, Quietness, ResourceSettings
from snakemake.workflow import Workflow

from tasklens.runtime import job
from tasklens.settings import names
from tasklens.study import claims, table_contents
from tasklens.study.loading import at_points, parse
from tasklens.study.run import digest
from tasklens.study.study import TABLES, Study

ROOT = Path(__file__).parents[1]
MODULES = sorted(p for package in digest.PACKAGES for p in (ROOT / package).rglob("*.py"))
_APIS = []  # garbage collection of the API would tear down its workflow


@cache
def workflow() -> Workflow:
    """The workflow, with the smoke study until `job` gives it another one."""
    folder = os.getcwd()
    api = SnakemakeApi(OutputSettings(quiet={Quietness.ALL})).__enter__()
    config = ConfigSettings(configfiles=[ROOT / "config" / "smoke.yaml"])
    parsed = api.workflow(ResourceSettings(cores=1), config, snakefile=ROOT / "Snakefile")
    _APIS.append((api, parsed))
    try:
        return parsed._workflow
    finally:
        os.chdir(folder)


@dataclass(frozen=True)
class Job:
    """A job of a rule: its settings as JSON, its files by name, and its function."""

    settings: str
    function: str
    code: str
    inputs: Mapping[str, Any]
    unawaited: Mapping[str, Any]
    outputs: Mapping[str, Path]
    log: Path

    def run(self) -> None:
        """Run the job in this process."""
        outputs = {name: str(path) for name, path in self.outputs.items()}
        job.run(self.function, self.settings, self.code, {**self.inputs, **self.unawaited}, outputs, self.log)

    @property
    def reads(self) -> list[Path]:
        """All input files that it waits for."""
        every = [[paths] if isinstance(paths, str) else paths for paths in self.inputs.values()]
        return [Path(path) for paths in every for path in paths]


def name_of(path: Path) -> str:
    """The name of a module of our packages."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def rule_names() -> list[str]:
    """The rules that call a function; targets do not."""
    return [rule.name for rule in workflow().rules if rule.is_script]


def job_of(name: str, study: Study, /, **wildcards: str | int) -> Job:
    """The job of a rule in a study; a job of a part has the wildcard `study`."""
    variables = workflow().globals
    variables |= {"STUDY": study, "POINTS": at_points(study)}
    for cached in ("study_named", "durations_in", "lenses_of_table1"):
        variables[cached].cache_clear()
    rule = workflow().get_rule(name)
    values = Wildcards(fromdict={"study": study.name} | {key: str(value) for key, value in wildcards.items()})
    inputs, *_ = rule.expand_input(values)
    outputs, _ = rule.expand_output(values)
    params = {key: value(values) if callable(value) else value for key, value in rule.params.items()}
    return Job(
        settings=params["settings"],
        function=params["function"],
        code=params["code"],
        inputs={key: value if isinstance(value, str) else [*value] for key, value in inputs.items()},
        unawaited=params.get("unawaited", {}),
        outputs={key: Path(value) for key, value in outputs.items()},
        log=Path(rule.expand_log(values)[0]),
    )


def outputs(name: str, study: Study, **wildcards: str | int) -> SimpleNamespace:
    """The output files of a job."""
    return SimpleNamespace(**job_of(name, study, **wildcards).outputs)


def finish(name: str, study: Study, **wildcards: str | int) -> SimpleNamespace:
    """Run a job of a study in the current folder and return its outputs."""
    current_job = job_of(name, study, **wildcards)
    current_job.run()
    return SimpleNamespace(**current_job.outputs)


def wildcards_of(name: str, study: Study) -> Iterator[dict]:
    """The wildcards of every job that a rule has in a study."""
    lenses = [*study.lenses, *study.variants]
    measures = name in ("fine_tune", "reproduce", "task_fine_tune")
    ranges = {
        "lens": [names.SHARP, *lenses] if measures else lenses,
        "classifier": study.classifiers,
        "measured_name": [*study.classifiers, *(names.measured_name(name, True) for name in study.classifiers)],
        "table": [table for table in TABLES if table_contents.table(study, table).lenses],
        "ablation": study.ablations,
        "elements": claims.claims_by_elements(study),
        "task": study.tasks.networks,
        "seed": study.seeds,
    }
    keys = [wildcard for wildcard in ranges if wildcard in workflow().get_rule(name).wildcard_names]
    for values in itertools.product(*(ranges[wildcard] for wildcard in keys)):
        wildcards = dict(zip(keys, values, strict=True))
        if not (wildcards.get("lens") == names.SHARP and names.split(wildcards.get("measured_name", ""))[1]):
            yield wildcards  # sharp images are not restored


def every_job(study: Study) -> Iterator[tuple[tuple, Job]]:
    """Every job that a study may have, by the name of its rule and its wildcards except the seed."""
    left_out = set() if study.sweep else {"sweep_table"}
    left_out |= set() if study.tasks.networks else {"scenes", "tasks_table"}
    left_out |= {"production", "tolerances_table"} if study.capture.diffraction else set()
    for name in rule_names():
        if name not in left_out:
            for wildcards in wildcards_of(name, study):
                key = (name, *(value for wildcard, value in wildcards.items() if wildcard != "seed"))
                yield key, job_of(name, study, **wildcards)


def reached(before: dict, after: dict) -> set[tuple]:
    """The jobs of a study that have other settings in another one."""
    return {job for job in before.keys() & after.keys() if before[job] != after[job]}


def slices(mapping: dict) -> dict[tuple, list[str]]:
    """Settings that Snakemake compares, for every job of a study and each seed."""
    return _slices(json.dumps(mapping))


@cache
def _slices(study: str) -> dict[tuple, list[str]]:
    settings: dict[tuple, list[str]] = {}
    for key, one_job in every_job(parse(json.loads(study))):
        settings.setdefault(key, []).append(one_job.settings)
    return settings
