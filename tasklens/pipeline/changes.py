"""What differs between two configurations of a study, and which finished results the new one would overwrite."""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tasklens.pipeline.forecast import Durations, duration
from tasklens.pipeline.jobs import fine_tune_others, others
from tasklens.pipeline.stage import STAGES
from tasklens.study.loading import load, resolved
from tasklens.study.study import Study, StudyError

COUNTED = {  # results that took long, by stage; what is made of them is overwritten without asking
    "design": "lenses",
    "reference": "classifiers",
    "fine_tune": "classifiers",
    "fine_tune_others": "classifiers",
    "restore": "restorations",
    "production": "toleranced lenses",
    "task_reference": "task networks",
    "task_fine_tune": "task networks",
}
_SHOWN = 10  # changed values in a message


@dataclass(frozen=True)
class Change:
    """A changed value of a study: its dotted key, the values before and after; None where it is new or gone."""

    key: str
    old: Any
    new: Any

    def __str__(self) -> str:
        if isinstance(self.new, dict) and self.old is None:
            return f"{self.key}: added"
        if isinstance(self.old, dict) and self.new is None:
            return f"{self.key}: removed"
        return f"{self.key}: {_shown(self.old)} -> {_shown(self.new)}"


def in_one_line(value: Any) -> str:
    """Return a value as YAML in one line."""
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1e9).removesuffix("\n...\n").strip()


def _shown(value: Any) -> str:
    text = in_one_line(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def changes(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[Change]:
    """Return the changed values between two resolved studies, in the order of their keys."""
    found: list[Change] = []
    for key in dict.fromkeys([*old, *new]):
        before, after, name = _by_number(old.get(key)), _by_number(new.get(key)), f"{prefix}{key}"
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            found += changes(before, after, f"{name}.")
        elif before != after:
            found.append(Change(name, before, after))
    return found


def _by_number(value: Any) -> Any:
    """Return a list of mappings, such as descents, by their numbers; any other value as it is."""
    listed = isinstance(value, list | tuple) and value and all(isinstance(entry, Mapping) for entry in value)
    return dict(enumerate(value)) if listed else value


@dataclass(frozen=True)
class PlannedJob:
    """A job that is to run.

    Attributes:
        exists: whether it has outputs.
        needs: labels of the jobs that it waits for.
        made_with: settings with which its outputs were made; None where that is not known.
    """

    stage: str
    wildcards: Mapping[str, str]
    exists: bool
    needs: tuple[str, ...]
    made_with: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Overwritten:
    """Finished results that a run would make again.

    Attributes:
        changes: changed values of the study; empty if only code or input files differ.
        by_values: stages of the jobs that a changed value makes again, directly or by what they read.
        otherwise: stages of the jobs that are made again for another reason: code, input files, or by request.
    """

    changes: tuple[Change, ...]
    by_values: tuple[str, ...]
    otherwise: tuple[str, ...]


def overwritten(stored: Path, study: Study, jobs: Mapping[str, PlannedJob]) -> Overwritten:
    """Find the finished results that the jobs of a run overwrite, where the study was stored before.

    A job is made again by a changed value if its settings differ from those with which its outputs were made, or if it
    reads what such a job makes, also where that was removed. Further seeds, lenses or classifiers change no settings of
    other jobs.

    Args:
        stored: the resolved study of the last run: its settings are taken where those of outputs are not known.
        jobs: the jobs of the run by label.
    """
    finished = {label for label, job in jobs.items() if job.exists and job.stage in COUNTED}
    if not finished or not stored.exists():
        return Overwritten((), (), ())
    try:
        before = load(stored)
    except StudyError:  # of another version
        before = None
    pairs = {label: _settings(job, before, study) for label, job in jobs.items()}
    different = {label for label, (old, new) in pairs.items() if old != new}
    affected = finished & _with_dependents(different, jobs)
    found = changes(yaml.safe_load(stored.read_text(encoding="utf-8")), resolved(study))
    if not found:  # made before another study of the same name, which was changed back
        found = [change for label in sorted(different) for change in changes(*pairs[label])]
    return Overwritten(
        tuple({str(change): change for change in found}.values()),
        tuple(jobs[label].stage for label in sorted(affected)),
        tuple(jobs[label].stage for label in sorted(finished - affected)),
    )


def _settings(job: PlannedJob, before: Study | None, after: Study) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings with which a job's outputs were made, and those with which they are to be made."""
    stage = STAGES[job.stage]
    new = json.loads(stage.plan_from(after, job.wildcards).settings.model_dump_json())
    try:
        if job.made_with is not None:
            old = dict(job.made_with)
        elif before is not None:
            old = json.loads(stage.plan_from(before, job.wildcards).settings.model_dump_json())
        else:
            return {}, new
    except StudyError:  # it was not in the study: new, unless there is an output of an earlier one
        return ({}, new) if job.exists else (new, new)
    if isinstance(old.get("classifiers"), dict):  # measured beside each other, with the numbers that each has alone
        common = old["classifiers"].keys() & new["classifiers"].keys()
        for each in (old, new):
            each["classifiers"] = {name: each["classifiers"][name] for name in common}
    return old, new


def _with_dependents(labels: Collection[str], jobs: Mapping[str, PlannedJob]) -> set[str]:
    """Return jobs, and all that wait for them, directly or not."""
    found = set(labels)
    grown = True
    while grown:
        more = {label for label, job in jobs.items() if label not in found and not found.isdisjoint(job.needs)}
        found |= more
        grown = bool(more)
    return found


def amount(stages: Iterable[str], study: Study, durations: Durations, cores: int) -> str:
    """Say how many results the jobs of some stages make, and how long they take on some cores."""
    stages = list(stages)
    counts: Counter[str] = Counter()
    for stage in stages:
        counts[COUNTED[stage]] += len(others(study)) if stage == fine_tune_others.name else 1
    words = [f"{count} {kind if count > 1 else _one(kind)}" for kind, count in counts.items()]
    known = [seconds for stage in stages if (seconds := durations.seconds(stage)) is not None]
    return f"{', '.join(words)} again" + (f", {duration(sum(known) / cores)}" if known else "")


def _one(kind: str) -> str:
    return kind[:-2] if kind.endswith("lenses") else kind[:-1]


def refusal(found: Overwritten, study: Study, durations: Durations, cores: int) -> str | None:
    """Return what to say instead of running, where changed values would overwrite finished results; else None."""
    if not found.by_values:
        return None
    total = amount(found.by_values, study, durations, cores)
    lines = [str(change) for change in found.changes[:_SHOWN]]
    if len(found.changes) > _SHOWN:
        lines.append(f"and {len(found.changes) - _SHOWN} more changed values")
    lines = [f"{lines[0]}: {total}"] if len(lines) == 1 else [*lines, f"together: {total}"]
    return "\n".join(
        [
            f"These changes would overwrite finished results of the study {study.name}; nothing was changed:",
            *(f"  {line}" for line in lines),
            f"Keep them, and give the new ones a name of their own:  --config name={study.name.partition('/')[0]}_2",
            "Or overwrite them:  --config overwrite=true",
        ]
    )
