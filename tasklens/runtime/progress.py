"""Progress of jobs: lines for logs, and a file of a running job for programs that show a run.

The file is results/<study>/progress/<label>.json. Its keys are `host`, `pid`, `started` and `updated` [s since 1970];
after the first step also `phase`, and for this phase `step`, `total`, `values` and `remaining_s`.
"""

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tasklens.runtime.files import temporary_of

# Called at every step with the label, the step (counted from 1), the number of steps, the values, and the remaining
# time [s], None at the first.
Listener = Callable[[str, int, int, Mapping[str, float], float | None], None]
_listeners: list[tuple[Listener, bool]] = []
_INTERVAL_S = 1.0  # least time between two writes


@contextmanager
def reporting_to(listener: Listener, lines: bool = False) -> Iterator[None]:
    """Report progress to `listener`, instead of lines on standard error or, with `lines`, in addition to them."""
    _listeners.append((listener, lines))
    try:
        yield
    finally:
        _listeners.remove((listener, lines))


class Progress:
    """Progress lines on standard error, at the first and last step, and at most every `interval` seconds between."""

    def __init__(self, label: str, total: int, interval: float = 15.0):
        self.label, self.total, self.interval = label, total, interval
        self.written = self.began = 0.0  # at the last line, and at the first
        self.first: int | None = None  # larger than 1 for a resumed job

    def __call__(self, step: int, **values: float) -> None:
        """Report that `step` of the total (counted from 1) is done."""
        now, remaining = time.monotonic(), None
        if self.first is None:  # this step may have compiled the tracer
            self.first, self.began = step, now
        elif step > self.first:
            remaining = (now - self.began) / (step - self.first) * (self.total - step)
        if _listeners:
            listener, lines = _listeners[-1]
            listener(self.label, step, self.total, values, remaining)
            if not lines:
                return
        if self.first < step != self.total and now - self.written < self.interval:
            return
        self.written = now
        text = "".join(f"  {name} {value:.4g}" for name, value in values.items())
        if remaining is not None and step != self.total:
            text += f"  remaining {remaining:.0f} s"
        print(f"{self.label}  step {step}/{self.total}{text}", file=sys.stderr, flush=True)


def _path(folder: str, label: str) -> Path:
    return Path(folder, "progress", f"{label}.json")


def read_progress(folder: str, label: str) -> Mapping[str, Any] | None:
    """Read the progress of a job; None if it has not reported yet, or has ended."""
    try:
        return json.loads(_path(folder, label).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


@contextmanager
def progress_file(folder: str, label: str) -> Iterator[None]:
    """Keep the progress file of this process' job up to date during the block; the log has progress lines too."""
    path = _path(folder, label)
    path.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {"host": socket.gethostname(), "pid": os.getpid(), "started": time.time()}
    written = 0.0

    def write() -> None:
        nonlocal written
        written = time.monotonic()
        temporary = temporary_of(path)
        try:
            temporary.write_text(json.dumps(content | {"updated": time.time()}), encoding="utf-8")
            os.replace(temporary, path)
        except OSError:  # on a full disk the job goes on without it
            temporary.unlink(missing_ok=True)

    def listen(phase: str, step: int, total: int, values: Mapping[str, float], remaining: float | None) -> None:
        content.update(phase=phase, step=step, total=total, values=dict(values))
        content.pop("remaining_s", None)
        if remaining is not None:
            content["remaining_s"] = remaining
        if time.monotonic() - written >= _INTERVAL_S:
            write()

    write()
    try:
        with reporting_to(listen, lines=True):
            yield
    finally:
        path.unlink(missing_ok=True)
