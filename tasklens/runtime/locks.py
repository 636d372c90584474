"""Locks between processes, and waiting for them with a line in the log now and then."""

import sys
import time
from collections.abc import Callable

from filelock import FileLock, Timeout

_SAID_S = 30.0  # between two lines


def acquire(lock: FileLock) -> bool:
    """Try to acquire a lock; return whether this process has it, or the file system knows no locks, which is said."""
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    except NotImplementedError:  # as of some clusters
        print(f"{lock.lock_file}: no locks on this file system; let one run at a time use it", file=sys.stderr)
    return True


def wait_until(ready: Callable[[], bool], what: str) -> None:
    """Wait until `ready` returns true, asked every second; say at once, and every half a minute, what is waited for."""
    began, said = time.monotonic(), -_SAID_S
    while not ready():
        waited = time.monotonic() - began
        if waited - said >= _SAID_S:
            said = waited
            print(f"waiting for {what}, {waited:.0f} s", file=sys.stderr, flush=True)
        time.sleep(1.0)
