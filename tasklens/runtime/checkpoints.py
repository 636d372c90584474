"""Checkpoints of long jobs: a resumed job gives the same numbers.

A job has named parts in sequence, such as a descent or a training. A finished part is saved by its result, an
unfinished one by its state; both with torch's random state and the part's history. The name of the file contains the
digest of what the job computes (`key`), so that a changed job does not resume from it. The file is not among the job's
outputs, which Snakemake deletes when a job fails.
"""

import copy
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from tasklens.runtime.devices import random_state, set_random_state
from tasklens.runtime.files import FileError, damage_error, replacing

INTERVAL = 60.0  # least time between two writes of the file [s]


class Checkpoint:
    """Checkpoint of one job, with its parts.

    Args:
        path: path of the file; None: nothing is saved.

    Raises:
        FileError: the file is no checkpoint.
    """

    def __init__(self, path: Path | None = None):
        self.path = path
        self.written = time.monotonic()
        self.records: dict[str, dict] = {}
        if path is not None and path.exists():
            try:
                self.records = torch.load(path, map_location="cpu", weights_only=True)
            except Exception as error:  # an error of pickle, zipfile or torch
                raise damage_error(path, f"not a checkpoint ({error})") from error

    def part(self, name: str, **holders: Any) -> "Part":
        """Return the part of this name; if it was saved, load the states of `holders` and torch's random state.

        Args:
            holders: objects with `state_dict` and `load_state_dict`, saved with an unfinished part.
        """
        record = self.records.get(name, {})
        if record:
            set_random_state(record["random"])
        for key, state in record.get("holders", {}).items():
            holders[key].load_state_dict(state)
        return Part(self, name, record, holders)

    def due(self) -> bool:
        """Return whether it is time to write the file."""
        return self.path is not None and time.monotonic() - self.written >= INTERVAL

    def write(self) -> None:
        """Write all parts to the file; raises FileError on a full disk."""
        assert self.path is not None  # only a checkpoint with a path is due
        with replacing(self.path) as temporary:
            try:
                torch.save(self.records, temporary)
            except RuntimeError as error:
                raise FileError(f"{self.path}: cannot be written ({error}); free disk space and run again") from error
        self.written = time.monotonic()


NO_CHECKPOINT = Checkpoint()


def _finite(state: object) -> bool:
    """Return whether all tensors in nested mappings and sequences are finite; no job may resume from others."""
    if isinstance(state, torch.Tensor):
        return bool(torch.isfinite(state).all())
    if isinstance(state, Mapping):
        return all(map(_finite, state.values()))
    return all(map(_finite, state)) if isinstance(state, list | tuple) else True


class Part:
    """One part of a job.

    Attributes:
        result: values passed to `finish`; None for an unfinished part.
        step: last saved step of an unfinished part, else 0.
        state: values passed to `save` at that step, else None.
        history: rows appended by the loop, saved with the part.
    """

    def __init__(self, checkpoint: Checkpoint, name: str, record: Mapping[str, Any], holders: Mapping[str, Any]):
        self.checkpoint, self.name, self.holders = checkpoint, name, holders
        self.result, self.step, self.state = record.get("result"), record.get("step", 0), record.get("state")
        self.history: list[dict[str, Any]] = [dict(row) for row in record.get("history", ())]

    def save(self, step: int, **state: Any) -> None:
        """Save the state after a step, if it is time and all tensors are finite."""
        if self.checkpoint.due():
            states = {name: holder.state_dict() for name, holder in self.holders.items()}
            if _finite(states) and _finite(state):
                self._remember({"step": step, "state": state, "holders": states})
                self.checkpoint.write()

    def finish(self, **result: Any) -> None:
        """Save the result of the finished part; the file is written if it is time."""
        if self.checkpoint.path is not None:
            self._remember({"result": result})
            if self.checkpoint.due():
                self.checkpoint.write()

    def _remember(self, record: dict[str, Any]) -> None:
        rows = [dict(row) for row in self.history]
        # A copy, since the tensors of a network change in place while a later part of the job is saved.
        self.checkpoint.records[self.name] = copy.deepcopy(record) | {"random": random_state(), "history": rows}
