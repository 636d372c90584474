"""Checkpoints of long jobs: a resumed job gives the same numbers.

A job has parts with names, one after the other: a descent, a training. A part that has ended is known by its result,
the one under way by its state; either is saved with torch's random state and the part's history. The file is named
after what the job computes (`key`), so that a changed job never resumes from it, and lies outside the job's outputs,
which Snakemake deletes when a job fails.
"""

import hashlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from tasklens.runtime.files import FileError, replacing

INTERVAL = 60.0  # seconds from one writing of a file to the next, at least


def key(*parts: str, inputs: Sequence[Path] = ()) -> str:
    """Digest of what a job computes: texts such as its slice of the study and its code, and its input files.

    Input files count by size and time of change, since images can be hundreds of gigabytes.
    """
    texts = list(parts)
    for path in inputs:
        status = path.stat()
        texts.append(f"{path} {status.st_size} {status.st_mtime_ns}")
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


class Checkpoint:
    """The parts of one job.

    Args:
        path: of the file; without one nothing is saved.

    Raises:
        FileError: the file is not one of ours.
    """

    def __init__(self, path: Path | None = None):
        self.path = path
        self.written = time.monotonic()
        self.records: dict[str, dict] = {}
        if path is not None and path.exists():
            try:
                self.records = torch.load(path, map_location="cpu", weights_only=True)
            except Exception as error:  # of pickle, zip or torch
                raise FileError(f"{path}: no checkpoint of this program; remove it ({error})") from error

    def part(self, name: str, **holders: Any) -> "Part":
        """The part of this name; where it is known, everything becomes what it was when that was written.

        Args:
            holders: what has `state_dict` and `load_state_dict`, saved while the part is under way.
        """
        record = self.records.get(name, {})
        if record:
            torch.set_rng_state(record["random"]["cpu"])
            if "gpu" in record["random"] and torch.cuda.is_available():
                torch.cuda.set_rng_state(record["random"]["gpu"])
        for key, state in record.get("holders", {}).items():
            holders[key].load_state_dict(state)
        return Part(self, name, record, holders)

    def due(self) -> bool:
        """Whether it is time to write."""
        return self.path is not None and time.monotonic() - self.written >= INTERVAL

    def write(self) -> None:
        """Write all parts that are known."""
        assert self.path is not None  # only a checkpoint with a file is ever due
        with replacing(self.path) as temporary:
            torch.save(self.records, temporary)
        self.written = time.monotonic()

    def remove(self) -> None:
        """Delete the file: the outputs of the job are complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


NO_CHECKPOINT = Checkpoint()


def _finite(state: object) -> bool:
    """Whether all tensors in nested mappings and sequences are: a state that is not is none to go on from."""
    if isinstance(state, torch.Tensor):
        return bool(torch.isfinite(state).all())
    if isinstance(state, Mapping):
        return all(map(_finite, state.values()))
    return all(map(_finite, state)) if isinstance(state, list | tuple) else True


class Part:
    """One part of a job.

    Attributes:
        result: what it ended with; None if it has not ended.
        step: how far it came; 0 if it has not begun.
        state: what its loop gave to `save` there.
        history: rows of what happened, which the loop appends; saved with the part.
    """

    def __init__(self, checkpoint: Checkpoint, name: str, record: Mapping[str, Any], holders: Mapping[str, Any]):
        self.checkpoint, self.name, self.holders = checkpoint, name, holders
        self.result, self.step, self.state = record.get("result"), record.get("step", 0), record.get("state")
        self.history: list[dict[str, Any]] = [dict(row) for row in record.get("history", ())]

    def save(self, step: int, **state: Any) -> None:
        """Say what the state is after a step: written if it is time, and if every number of it is finite."""
        if self.checkpoint.due():
            held = {name: holder.state_dict() for name, holder in self.holders.items()}
            if _finite(held) and _finite(state):
                self._remember({"step": step, "state": state, "holders": held})
                self.checkpoint.write()

    def finish(self, **result: Any) -> None:
        """Say what the part ended with."""
        if self.checkpoint.path is not None:
            self._remember({"result": result})
            if self.checkpoint.due():
                self.checkpoint.write()

    def _remember(self, record: dict[str, Any]) -> None:
        random = {"cpu": torch.get_rng_state()}
        if torch.cuda.is_initialized():  # dropout draws there
            random["gpu"] = torch.cuda.get_rng_state()
        rows = [dict(row) for row in self.history]
        self.checkpoint.records[self.name] = record | {"random": random, "history": rows}
