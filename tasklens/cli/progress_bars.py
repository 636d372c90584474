"""Progress of a command on a terminal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def progress_bars() -> Iterator[None]:
    """Show a progress bar for each part of the work on a terminal; otherwise print lines as jobs do."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tasklens.runtime.progress import reporting_to

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, TextColumn("{task.fields[values]}"), console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def listen(label: str, step: int, total: int, values: Any) -> None:
            if label not in tasks or bars.tasks[tasks[label]].completed >= total > step:  # a new part of the same name
                tasks[label] = bars.add_task(label, total=total, values="")
            first = next(iter(values.items()), None)
            bars.update(tasks[label], completed=min(step, total), values=f"{first[0]} {first[1]:.4g}" if first else "")

        with reporting_to(listen):
            yield
