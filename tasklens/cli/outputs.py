"""Output of commands: messages, progress, JSON, and files that are not overwritten by accident."""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic_core import to_json

from tasklens.materials.material import Material
from tasklens.runtime.errors import InputError

Force = Annotated[bool, typer.Option("--force", help="Overwrite the output file.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


def new_file(path: Path, force: bool, *suffixes: str) -> None:
    """Check the path of an output; raises InputError if it exists or has none of the suffixes."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    if path.is_dir() or (path.exists() and not force):
        raise InputError(f"{path}: already exists; --force overwrites it" if path.is_file() else f"{path}: is a folder")


def new_catalogue(path: Path, force: bool) -> None:
    """Check the path of the glass catalogue that a Zemax file may need; raises InputError as `new_file` does."""
    if " " in path.stem:
        raise InputError(
            f"{path}: its glass catalogue would have the same name, which cannot contain spaces; rename it"
        )
    new_file(path.with_suffix(".agf"), force, ".agf")


def say_catalogue(path: Path, media: Sequence[Material]) -> None:
    """Say which glasses the catalogue of a written Zemax file has, if it needed one."""
    from tasklens.optics.io.zemax_glasses import NamedGlasses

    if path.suffix.lower() == ".zmx" and (glasses := NamedGlasses.of(media, path.stem).own):
        names = ", ".join(glass.name for glass in glasses)
        say(f"wrote {path.with_suffix('.agf')} with {names}, for OpticStudio's folder Glasscat")


def print_json(content: Any) -> None:
    """Print JSON; numbers that are not finite become null."""
    print(to_json(content, indent=2, inf_nan_mode="null").decode())


@contextmanager
def remarks_about(path: Path) -> Iterator[None]:
    """Say each warning of our Python functions about a file once, as a message on standard error."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        show, said = warnings.showwarning, set()

        def say_once(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
            if category is not UserWarning:
                show(message, category, *where, **options)
            elif (text := str(message)) not in said:
                said.add(text)
                say(f"{path}: {text}")

        warnings.showwarning = say_once  # type: ignore[assignment]  # it passes the place of a warning on
        yield


def say(text: str) -> None:
    """Print a message for the user on standard error; standard output is for results."""
    print(f"tasklens: {text}", file=sys.stderr)


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

        def listen(label: str, step: int, total: int, values: Any, _: float | None) -> None:
            if label not in tasks or bars.tasks[tasks[label]].completed >= total > step:  # a new part of the same name
                tasks[label] = bars.add_task(label, total=total, values="")
            first = next(iter(values.items()), None)
            bars.update(tasks[label], completed=min(step, total), values=f"{first[0]} {first[1]:.4g}" if first else "")

        with reporting_to(listen):
            yield
