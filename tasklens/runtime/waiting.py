"""Waiting for what other processes hold, with a line in the log now and then."""

import sys
import time
from collections.abc import Callable

_SAID_S = 30.0  # between two lines


def wait_until(ready: Callable[[], bool], what: str) -> None:
    """Wait until `ready` returns true, asked every second; say at once, and every half a minute, what is waited for."""
    began, said = time.monotonic(), -_SAID_S
    while not ready():
        waited = time.monotonic() - began
        if waited - said >= _SAID_S:
            said = waited
            print(f"waiting for {what}, {waited:.0f} s", file=sys.stderr, flush=True)
        time.sleep(1.0)
