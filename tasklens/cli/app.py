"""The command `tasklens`: its groups, and how it ends.

Only commands that need torch import it: each job of a study starts this program.
"""

import os
import sys
import warnings

import typer
from typer.main import get_command

from tasklens.cli import design, lens, run, study
from tasklens.cli.schema import schema
from tasklens.runtime.errors import InputError

app = typer.Typer(
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
study.app.command()(schema)
app.add_typer(lens.app, name="lens", help="Look at lenses: a lens.yaml, or Zemax's .zmx.")
app.command()(design.design)
app.add_typer(study.app, name="study", help="Compare lenses, networks and seeds: a study, which `snakemake` runs.")
app.add_typer(run.app(), name="run", help="Run one job of a study by hand, as its rules do.")


@app.callback()
def overview(context: typer.Context) -> None:
    """Lenses designed for a task: `tasklens` alone lists all commands, `tasklens COMMAND --help` explains one."""
    if context.invoked_subcommand is None:
        print(_overview())


def _overview() -> str:
    """List all commands by group, each with the first sentence of its help."""
    lines = ["TaskLens: lenses designed for a task."]
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]  # of a group
        members = getattr(command, "commands", {})
        lines += ["", f"tasklens {name} ...   {command.help}" if members else f"tasklens {name}   {_sentence(command)}"]
        lines += [f"  {member:<18} {_sentence(each)}" for member, each in members.items()]
    return "\n".join(
        [*lines, "", "Each explains itself: tasklens lens draw --help. Shell: tasklens --install-completion"]
    )


def _sentence(command: typer.main.TyperCommand) -> str:
    return (command.help or "").split("\n\n")[0].replace("\n", " ").removesuffix(".")


def _is_of_memory(error: Exception) -> bool:
    """Return whether memory is lacking: Python's, torch's, or that of a GPU; without torch."""
    kinds = [kind.__name__ for kind in type(error).__mro__]
    return bool({"MemoryError", "OutOfMemoryError"} & set(kinds)) or "can't allocate memory" in str(error)


def main(argv: list[str] | None = None) -> int:
    """Run one command; return exit status 2 for a user error, 1 for a failed verification, else 0.

    As a program, without `argv`, it does not return: the process ends without freeing every object, which takes longer
    than some jobs. All files are complete then.
    """
    # torch causes this warning itself, at the first forward-mode derivative of a process.
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
    try:
        app(args=argv, prog_name="tasklens")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except (InputError, FloatingPointError) as error:
        print(f"tasklens: {error}", file=sys.stderr)
        status = 2
    except OSError as error:
        if error.filename is None:
            raise
        print(f"tasklens: {error.filename}: {(error.strerror or 'cannot be used').lower()}", file=sys.stderr)
        status = 2
    except (MemoryError, RuntimeError) as error:
        if not _is_of_memory(error):
            raise
        print(f"tasklens: not enough memory ({error}); run fewer jobs at once, or lower batch_size", file=sys.stderr)
        status = 2
    if argv is None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status
