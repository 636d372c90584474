"""What differs between two configurations of a study, and which finished results the new one would overwrite."""

import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tasklens.pipeline.forecast import Durations, duration
from tasklens.study.loading import resolved
from tasklens.study.study import Study

COUNTED = {  # results that took long, by rule; what is made of them is overwritten without asking
    "design": "lenses",
    "reference": "classifiers",
    "fine_tune": "classifiers",
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
    """A job that a run needs.

    Attributes:
        study: name of its study.
        label: its rule and wildcards, such as `design/doublet-tasklens-seed0`.
        remains: whether it is to run.
        outputs: those of its outputs that are there.
        needs: labels of the jobs that it waits for.
        settings: its settings as JSON.
        made_with: settings with which its outputs were made; None if that is not known.
    """

    study: str
    label: str
    remains: bool
    outputs: tuple[str, ...]
    needs: tuple[str, ...]
    settings: str
    made_with: str | None = None

    @property
    def rule(self) -> str:
        """Name of its rule."""
        return self.label.partition("/")[0]


@dataclass(frozen=True)
class Overwritten:
    """Finished results that a run would make again.

    Attributes:
        changes: changed values of the study; empty if only code or input files differ.
        by_values: rules of the jobs that a changed value makes again, directly or by what they read.
        otherwise: rules of the jobs that are made again for another reason: code, input files, or by request.
    """

    changes: tuple[Change, ...]
    by_values: tuple[str, ...]
    otherwise: tuple[str, ...]


def overwritten(study: Study, jobs: Mapping[str, PlannedJob]) -> Overwritten:
    """Find the finished results that the jobs of a run overwrite.

    A job is made again by a changed value if its settings differ from those with which its outputs were made, or if it
    reads what such a job makes. Further seeds, lenses or classifiers change no settings of other jobs.

    Args:
        jobs: the jobs of the run by label.
    """
    finished = {label for label, job in jobs.items() if job.outputs and job.rule in COUNTED}
    pairs = {k: (json.loads(job.made_with), json.loads(job.settings)) for k, job in jobs.items() if job.made_with}
    different = {label: pair for label, pair in pairs.items() if pair[0] != pair[1]}
    affected = finished & _with_dependents(different, jobs)
    stored = Path("results", study.name, "study.yaml")
    found = changes(yaml.safe_load(stored.read_text(encoding="utf-8")), resolved(study)) if stored.exists() else []
    if not found:  # made before another study of the same name, which was changed back
        found = [change for label in sorted(different) for change in changes(*different[label])]
    return Overwritten(
        tuple({str(change): change for change in found}.values()),
        tuple(jobs[label].rule for label in sorted(affected)),
        tuple(jobs[label].rule for label in sorted(finished - affected)),
    )


def _with_dependents(labels: Collection[str], jobs: Mapping[str, PlannedJob]) -> set[str]:
    """Return jobs, and all that wait for them, directly or not."""
    found = set(labels)
    grown = True
    while grown:
        more = {label for label, job in jobs.items() if label not in found and not found.isdisjoint(job.needs)}
        found |= more
        grown = bool(more)
    return found


def amount(rules: Sequence[str], durations: Durations, cores: int) -> str:
    """Say how many results the jobs of some rules make, and how long they take on some cores."""
    counts = Counter(COUNTED[rule] for rule in rules)
    words = [f"{count} {kind if count > 1 else _one(kind)}" for kind, count in counts.items()]
    known = [seconds for rule in rules if (seconds := durations.seconds(rule)) is not None]
    return f"{', '.join(words)} again" + (f", {duration(sum(known) / cores)}" if known else "")


def _one(kind: str) -> str:
    return kind[:-2] if kind.endswith("lenses") else kind[:-1]


def refusal(found: Overwritten, study: str, durations: Durations, cores: int) -> str | None:
    """Return what to say instead of running if changed values would overwrite finished results; else None."""
    if not found.by_values:
        return None
    total = amount(found.by_values, durations, cores)
    lines = [str(change) for change in found.changes[:_SHOWN]]
    if len(found.changes) > _SHOWN:
        lines.append(f"and {len(found.changes) - _SHOWN} more changed values")
    lines = [f"{lines[0]}: {total}"] if len(lines) == 1 else [*lines, f"together: {total}"]
    return "\n".join(
        [
            f"These changes would overwrite finished results of the study {study}; nothing was changed:",
            *(f"  {line}" for line in lines),
            f"Keep them, and give the study another name in its file, or:  --config name={study.partition('/')[0]}_2",
            "Or overwrite them:  --config overwrite=true",
        ]
    )
