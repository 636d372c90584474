"""The command `tasklens`: its groups and its exit status.

Only commands that need torch import it.
"""

import typer
from typer.main import get_command

from tasklens.cli import capture_commands, design_command, lens_commands, rank_command, study_commands
from tasklens.runtime.job import exit_status, run_program

app = typer.Typer(
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _command in (capture_commands.simulate, capture_commands.captures):
    lens_commands.app.command()(_command)
app.add_typer(lens_commands.app, name="lens", help="Inspect lenses: .yaml or Zemax .zmx files.")
app.command()(design_command.design)
app.command()(rank_command.rank)
app.add_typer(
    study_commands.app, name="study", help="Compare lenses, networks and seeds in a study, which `snakemake` runs."
)


@app.callback()
def overview(context: typer.Context) -> None:
    """Lenses designed for a task: `tasklens` alone lists all commands, `tasklens COMMAND --help` explains one."""
    if context.invoked_subcommand is None:
        print(_overview())


def _overview() -> str:
    """List all commands by group, each with the first sentence of its help."""
    lines = ["TaskLens: design lenses for a neural network."]
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]  # of a group
        members = getattr(command, "commands", {})
        lines += ["", f"tasklens {name} ...   {command.help}" if members else f"tasklens {name}   {_sentence(command)}"]
        lines += [
            f"  {member:<18} {_sentence(subcommand)}" for member, subcommand in members.items() if not subcommand.hidden
        ]
    return "\n".join(
        [*lines, "", "Help on a command: tasklens lens draw --help. Shell completion: tasklens --install-completion"]
    )


def _sentence(command: typer.main.TyperCommand) -> str:
    return (command.help or "").split("\n\n")[0].replace("\n", " ").removesuffix(".")


def main(argv: list[str] | None = None) -> int:
    """Run one command; return exit status 2 for a user error, 1 for a failed verification, else 0.

    As a program, without `argv`, it does not return (see `run_program`).
    """
    if argv is None:
        run_program(lambda: app(prog_name="tasklens"), None)
    return exit_status(lambda: app(args=argv, prog_name="tasklens"))
