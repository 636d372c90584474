"""Progress of a job: lines for its log, and a small file that says where it is while it runs."""

import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tasklens.runtime.files import temporary_of

_INTERVAL_S = 1.0  # least time between two writings of the file

_file: Path | None = None  # of the job that this process runs
_content: dict[str, Any] = {}
_written = 0.0


@contextmanager
def progress_file(path: Path) -> Iterator[None]:
    """Keep the progress of this process in a JSON file while the block runs; it is removed at its end.

    Its keys: `host`, `pid`, `started` and `updated` [s since 1970]; of the present phase `phase`, `step`, `total`,
    `values` and `remaining_s`, once there are steps.
    """
    global _file, _content
    path.parent.mkdir(parents=True, exist_ok=True)
    _file, _content = path, {"host": socket.gethostname(), "pid": os.getpid(), "started": time.time()}
    _write()
    try:
        yield
    finally:
        _file = None
        path.unlink(missing_ok=True)


def _write() -> None:
    """Replace the file; where that fails, as on a full disk, the job goes on without it."""
    global _written
    if _file is None:
        return
    _written = time.monotonic()
    temporary = temporary_of(_file)
    try:
        temporary.write_text(json.dumps(_content | {"updated": time.time()}), encoding="utf-8")
        os.replace(temporary, _file)
    except OSError:
        temporary.unlink(missing_ok=True)


class Progress:
    """Progress lines on standard error, at the first and last step, and at most every `interval` seconds between.

    The file of `progress_file` has each of them, and what comes between, once a second.
    """

    def __init__(self, label: str, total: int, interval: float = 15.0):
        self.label, self.total, self.interval = label, total, interval
        self.start = self.written = time.monotonic()
        self.first: int | None = None  # larger than 1 for a resumed job

    def __call__(self, step: int, **values: float) -> None:
        """Report that `step` of the total (counted from 1) is done."""
        now = time.monotonic()
        if self.first is None:
            self.first = step
        line = not self.first < step < self.total or now - self.written >= self.interval
        if not line and (_file is None or now - _written < _INTERVAL_S):
            return
        remaining = (now - self.start) / (step - self.first + 1) * max(0, self.total - step)
        _content.update(phase=self.label, step=step, total=self.total, values=values, remaining_s=remaining)
        _write()
        if line:
            self.written = now
            shown = "".join(f"  {name} {value:.4g}" for name, value in values.items())
            print(
                f"{self.label}  step {step}/{self.total}{shown}  remaining {remaining:.0f} s",
                file=sys.stderr,
                flush=True,
            )
