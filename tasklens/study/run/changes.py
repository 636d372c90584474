"""Differences between two configurations of a study, and the finished results that the new one would overwrite."""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tasklens.study.loading import read, resolve
from tasklens.study.run.forecast import Durations, duration
from tasklens.study.study import Study

COUNTED = {  # expensive results, by rule; results derived from them are overwritten without asking
    "design": "lenses",
    "reference": "classifiers",
    "fine_tune": "classifiers",
    "restore": "restorations",
    "production": "toleranced lenses",
    "task_reference": "task networks",
    "task_fine_tune": "task networks",
}
_COLLECTIONS = ("elements", "designs", "imported", "classifiers", "ablations")  # sections with entries by name
_SHOWN = 10  # changed values in a message


@dataclass(frozen=True)
class Change:
    """A changed value of a study: its dotted key, and the values before and after (None if it was added or removed)."""

    key: str
    old: Any
    new: Any

    def __str__(self) -> str:
        if isinstance(self.new, dict) and self.old is None:
            return f"{self.key}: added"
        if isinstance(self.old, dict) and self.new is None:
            return f"{self.key}: removed"
        return f"{self.key}: {_shorten(self.old)} -> {_shorten(self.new)}"


def in_one_line(value: Any) -> str:
    """Return a value as YAML in one line."""
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1e9).removesuffix("\n...\n").strip()


def _shorten(value: Any) -> str:
    text = in_one_line(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def changes(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[Change]:
    """Return the changed values between two resolved studies, in the order of their keys."""
    diffs: list[Change] = []
    for key in dict.fromkeys([*old, *new]):
        before, after, name = _by_number(old.get(key)), _by_number(new.get(key)), f"{prefix}{key}"
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            diffs += changes(before, after, f"{name}.")
        elif before != after:
            diffs.append(Change(name, before, after))
    return diffs


def since_last_run(study: Study) -> list[Change]:
    """Return the values changed since the last run of a study; none before the first run."""
    stored = Path("results", study.name, "study.yaml")
    return changes(read(stored), resolve(study)) if stored.exists() else []


def _by_number(value: Any) -> Any:
    """Return a list of mappings, such as descents, as a dictionary by index; any other value unchanged."""
    is_list = isinstance(value, list | tuple) and value and all(isinstance(entry, Mapping) for entry in value)
    return dict(enumerate(value)) if is_list else value


@dataclass(frozen=True)
class PlannedJob:
    """A job that a run needs.

    Attributes:
        study: name of its study.
        label: its rule and wildcards, such as `design/doublet-tasklens-seed0`.
        remains: whether it still has to run.
        outputs: its outputs that exist.
        needs: labels of the jobs that it waits for.
        settings: its settings as JSON.
        code: digest of its code.
        made_with, made_by: settings and digest that its outputs were made with; None if unknown.
        priority: Snakemake's priority; 0 if it does not have to run.
    """

    study: str
    label: str
    remains: bool
    outputs: tuple[str, ...]
    needs: tuple[str, ...]
    settings: str
    code: str = ""
    made_with: str | None = None
    made_by: str | None = None
    priority: float = 0.0

    @property
    def rule(self) -> str:
        """Name of its rule."""
        return self.label.partition("/")[0]


@dataclass(frozen=True)
class Overwritten:
    """Finished results that a run would overwrite.

    Attributes:
        changes: changed values of the study; empty if only code or input files differ.
        by_values: rules of the jobs that a changed value repeats, directly or through their inputs.
        by_code: rules of the other jobs that changed code repeats.
        otherwise: rules of the jobs that run again for another reason: input files, or a request.
    """

    changes: tuple[Change, ...]
    by_values: tuple[str, ...]
    by_code: tuple[str, ...]
    otherwise: tuple[str, ...]


def find_overwritten(study: Study, jobs: Mapping[str, PlannedJob]) -> Overwritten:
    """Find the finished results that the jobs of a run overwrite.

    A changed value repeats a job if its settings differ from the settings that its outputs were made with, or if it
    reads outputs of such a job. Additional seeds, lenses or classifiers do not change the settings of other jobs.

    Args:
        jobs: the jobs of the run by label.
    """
    finished_labels = {label for label, job in jobs.items() if job.outputs and job.rule in COUNTED}
    changed_settings = {
        label: (json.loads(job.made_with), json.loads(job.settings))
        for label, job in jobs.items()
        if job.made_with and job.made_with != job.settings  # as text, like Snakemake
    }
    changed_code = {label for label, job in jobs.items() if job.made_by not in (None, job.code)}
    by_values = finished_labels & _with_dependents(changed_settings, jobs)
    by_code = finished_labels & _with_dependents(changed_code, jobs) - by_values
    others = finished_labels - by_values - by_code
    diffs = since_last_run(study)
    if not diffs:  # the results come from an earlier study of the same name
        diffs = [change for label in sorted(changed_settings) for change in changes(*changed_settings[label])]
    return Overwritten(
        tuple({str(change): change for change in diffs}.values()),
        *(tuple(jobs[label].rule for label in sorted(group)) for group in (by_values, by_code, others)),
    )


def find_unrecorded(study: Study, jobs: Iterable[PlannedJob]) -> str | None:
    """Return the error message if results of other settings would be taken for those of the study; otherwise None.

    Snakemake does not know the settings of results that were copied without its folder.

    Args:
        jobs: all jobs that the targets need, also those that do not have to run.
    """
    unknown = [job for job in jobs if job.rule in COUNTED and job.outputs and not job.remains and job.made_with is None]
    diffs = [change for change in since_last_run(study) if not _is_addition(change)]
    if not unknown or not diffs:
        return None
    return "\n".join(
        [
            f"results/{study.name} was made with other settings, and Snakemake's record of them is not here:",
            *(f"  {change}" for change in diffs[:_SHOWN]),
            "Copy the folder .snakemake from where the results were made, give the study another name, or delete the "
            "results.",
        ]
    )


def _is_addition(change: Change) -> bool:
    """Return whether a change leaves the existing jobs as they are: more seeds, tables, lenses or networks."""
    section, _, name = change.key.partition(".")
    if change.old is None:
        return section in _COLLECTIONS and "." not in name
    return section in ("seeds", "tables") and set(change.old) <= set(change.new)


def _with_dependents(labels: Collection[str], jobs: Mapping[str, PlannedJob]) -> set[str]:
    """Return the labels of jobs, and of all jobs that depend on them directly or indirectly."""
    closure = set(labels)
    is_growing = True
    while is_growing:
        more = {label for label, job in jobs.items() if label not in closure and not closure.isdisjoint(job.needs)}
        closure |= more
        is_growing = bool(more)
    return closure


def amount(rules: Sequence[str], durations: Durations, cores: int) -> str:
    """Describe how many results the jobs of these rules make, and how long they take on this number of cores."""
    counts = Counter(COUNTED[rule] for rule in rules)
    words = [f"{count} {kind if count > 1 else _one(kind)}" for kind, count in counts.items()]
    seconds, unknown = durations.total(rules)
    return f"{', '.join(words)} again" + (f", {duration(seconds / cores)}" if {*rules} - {*unknown} else "")


def _one(kind: str) -> str:
    return kind[:-2] if kind.endswith("lenses") else kind[:-1]


def refusal(overwrites: Overwritten, study: str, durations: Durations, cores: int, ranking: bool = False) -> str | None:
    """Return the error message if changed values or code would overwrite finished results; otherwise None.

    Args:
        ranking: the study is that of a ranking, whose options the message names.
    """
    lines = []
    if overwrites.by_values:
        total = amount(overwrites.by_values, durations, cores)
        lines = [str(change) for change in overwrites.changes[:_SHOWN]]
        if len(overwrites.changes) > _SHOWN:
            lines.append(f"and {len(overwrites.changes) - _SHOWN} more changed values")
        lines = lines or ["values in another order or format"]
        lines = [f"{lines[0]}: {total}"] if len(lines) == 1 else [*lines, f"together: {total}"]
    if overwrites.by_code:
        lines.append(f"changed code of TaskLens: {amount(overwrites.by_code, durations, cores)}")
    if not lines:
        return None
    name = f"{study.partition('/')[0]}_2"
    keep, overwrite = (
        (f"choose another:  --name {name}", "--overwrite")
        if ranking
        else (f"give the study another name in its file, or:  --config name={name}", "--config overwrite=true")
    )
    return "\n".join(
        [
            f"These changes would overwrite finished results of the study {study}; nothing was changed:",
            *(f"  {line}" for line in lines),
            f"Keep them, and {keep}",
            *(
                ["Or take them for results of the present code:  the same command with --touch"]
                if overwrites.by_code and not overwrites.by_values and not ranking
                else []
            ),
            f"Or overwrite them:  {overwrite}",
        ]
    )
