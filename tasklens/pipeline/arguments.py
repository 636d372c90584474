"""The arguments of the command line: what each stage is told."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

from tasklens.pipeline.layout import SHARP
from tasklens.study.study import TABLES, load


def _count(text: str) -> int:
    """A whole number above zero."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above zero, got {text!r}")
    return int(text)


_MEANING = {
    "lens": {"help": f"name of a lens; {SHARP} for the pictures themselves, where a classifier follows"},
    "classifier": {},
    "table": {"choices": TABLES},
    "ablation": {},
    "elements": {},
    "--seed": {"type": int, "default": 0},
    "--threads": {"type": _count, "default": 1, "help": "that decode photographs at once"},
    "--restored": {"action": "store_true", "help": "on captures restored by NAFNet"},
    "--networks": {"action": "store_true", "help": "build every classifier once, without weights"},
    "--partial": {"action": "store_true", "help": "of what has been measured, as <table>-partial"},
}


def parser(purpose: str, stages: Mapping[Callable, tuple[str, ...]], analyse: Callable) -> argparse.ArgumentParser:
    """The command line: a subcommand per stage with its arguments, and `analyse`, which needs no study."""
    top = argparse.ArgumentParser(prog="tasklens", description=purpose)
    commands = top.add_subparsers(required=True, metavar="stage")
    for stage, arguments in stages.items():
        command = commands.add_parser(stage.__name__.replace("_", "-"), help=stage.__doc__, description=stage.__doc__)
        command.add_argument("study", type=Path, help="study file (YAML)")
        for name in arguments:
            command.add_argument(name, **_MEANING[name])
        command.set_defaults(run=lambda args, stage=stage: stage(load(args.study), args))
    command = commands.add_parser(analyse.__name__, help=analyse.__doc__, description=analyse.__doc__)
    command.add_argument("file", type=Path, help="lens file (YAML) with its spec")
    command.add_argument("--rays", type=_count, default=4096, help="per field and colour")
    command.set_defaults(run=analyse)
    return top
