"""Progress file of a running job, results/<study>/progress/<label>.json, for programs that show a run.

Keys: `host`, `pid`, `started` and `updated` [s since 1970]; after the first step also `phase`, and for this phase
`step`, `total`, `values` and `remaining_s`.
"""

import json
import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tasklens.runtime.files import temporary_of
from tasklens.runtime.progress import reporting_to

_INTERVAL_S = 1.0  # least time between two writes


def _path(folder: str, label: str) -> Path:
    return Path(folder, "progress", f"{label}.json")


def read(folder: str, label: str) -> Mapping[str, Any] | None:
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
    first, began, written = 0, 0.0, 0.0

    def write() -> None:
        nonlocal written
        written = time.monotonic()
        temporary = temporary_of(path)
        try:
            temporary.write_text(json.dumps(content | {"updated": time.time()}), encoding="utf-8")
            os.replace(temporary, path)
        except OSError:  # on a full disk the job goes on without it
            temporary.unlink(missing_ok=True)

    def listen(phase: str, step: int, total: int, values: Mapping[str, float]) -> None:
        nonlocal first, began
        now = time.monotonic()
        if content.get("phase") != phase or step <= first:
            first, began = step, now
            content.pop("remaining_s", None)
        content.update(phase=phase, step=step, total=total, values=dict(values))
        if step > first:
            content["remaining_s"] = (now - began) / (step - first) * (total - step)
        if now - written >= _INTERVAL_S:
            write()

    write()
    try:
        with reporting_to(listen, lines=True):
            yield
    finally:
        path.unlink(missing_ok=True)
