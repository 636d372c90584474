"""`tasklens lens ...` in tests: lenses of ours and of Zemax for it, its exit status and its output."""

import json

import pytest
from examples import HEADLINE
from reference_files import SHIPPED

from tasklens.cli.app import main

DOUBLET = HEADLINE / "doublet-imaging2.yaml"
SAME = DOUBLET.with_suffix(".zmx")
PHONE = SHIPPED / "lenses/cellphone/source/US-9897779-B2-e1.zmx"
FEW = ("--rays", "64")


def run(*arguments) -> int:
    return main(["lens", *map(str, arguments)])


def output_of(capsys, *arguments) -> str:
    """Return the standard output of a command that succeeds."""
    assert run(*arguments) == 0
    return capsys.readouterr().out


def json_of(capsys, *arguments) -> dict:
    """The JSON that a command prints; NaN and Infinity, which JSON does not have, are refused."""
    return json.loads(output_of(capsys, *arguments, "--json"), parse_constant=lambda name: pytest.fail(name))
