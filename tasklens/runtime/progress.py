"""Progress lines for logs: step, values and remaining time."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

# Called at every step with the label, the step (counted from 1), the number of steps and the values.
Listener = Callable[[str, int, int, Mapping[str, float]], None]
_listeners: list[tuple[Listener, bool]] = []


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
        self.start = self.written = time.monotonic()
        self.first: int | None = None  # larger than 1 for a resumed job

    def __call__(self, step: int, **values: float) -> None:
        """Report that `step` of the total (counted from 1) is done."""
        if _listeners:
            listener, lines = _listeners[-1]
            listener(self.label, step, self.total, values)
            if not lines:
                return
        now = time.monotonic()
        if self.first is None:
            self.first = step
        if self.first < step != self.total and now - self.written < self.interval:
            return
        self.written = now
        remaining = (now - self.start) / (step - self.first + 1) * max(0, self.total - step)
        text = "".join(f"  {name} {value:.4g}" for name, value in values.items())
        line = f"{self.label}  step {step}/{self.total}{text}  remaining {remaining:.0f} s"
        print(line, file=sys.stderr, flush=True)
