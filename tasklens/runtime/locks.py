"""Locks between processes; a process that waits prints a line to the log now and then."""

import sys
import time
from collections.abc import Callable

from filelock import FileLock, Timeout

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
