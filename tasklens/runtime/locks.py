"""Locks between processes, and one process at a time for each job; a waiting process prints a line now and then."""

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from tasklens.runtime.files import write_text

_REMINDER_S = 30.0  # time between two lines


def acquire(lock: FileLock) -> bool:
    """Try to acquire a lock.

    Returns:
        True if this process has the lock; also true, with a warning, if the file system has no locks.
    """
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    except NotImplementedError:  # on file systems of some clusters
        print(f"{lock.lock_file}: this file system has no file locks; use it from one run at a time", file=sys.stderr)
    return True


def wait_until(ready: Callable[[], bool], what: str) -> None:
    """Wait until `ready`, called every second, returns true; print `what` at once and then every half minute."""
    began, last = time.monotonic(), -_REMINDER_S
    while not ready():
        waited = time.monotonic() - began
        if waited - last >= _REMINDER_S:
            last = waited
            print(f"waiting for {what}, {waited:.0f} s", file=sys.stderr, flush=True)
        time.sleep(1.0)


@contextmanager
def alone(path: Path, key: str, outputs: Iterable[Path]) -> Iterator[bool]:
    """Let no other process run a job while the block runs; wait for one that already does.

    Args:
        path: path of the lock; the last process that held it leaves its host and id in a JSON file of the same name.
        key: digest of what the job computes.
        outputs: outputs of the job.

    Yields:
        True if there is work; false if this process waited for another that computed the same, and its outputs exist.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock, record = FileLock(path), path.with_suffix(".json")
    waited = not acquire(lock)
    if waited:
        other = _read(record)
        wait_until(lambda: acquire(lock), f"process {other.get('pid')} on {other.get('host')}, which runs this job")
    try:
        done = waited and _read(record).get("done") == key and all(output.exists() for output in outputs)
        process = {"pid": os.getpid(), "host": socket.gethostname()}
        if not done:
            write_text(record, json.dumps(process))
        yield not done
        if not done:  # not reached if the job fails or is killed: older outputs may exist then
            write_text(record, json.dumps(process | {"done": key}))
    finally:
        lock.release()


def _read(record: Path) -> dict[str, Any]:
    try:
        return json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # not written yet, or by a killed process
        return {}
