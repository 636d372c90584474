"""Options of the commands that have a network and photographs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import yaml

from tasklens.runtime.errors import InputError
from tasklens.runtime.user_code import is_users

_PANEL = "Network and photographs"

Images = Annotated[
    Path | None,
    typer.Option(
        help="Folder of photographs: <class>/*, or train/<class>/* and test/<class>/*.", rich_help_panel=_PANEL
    ),
]
SaveNetwork = Annotated[
    Path | None,
    typer.Option(help="File for the network that joint or end_to_end trains, .safetensors.", rich_help_panel=_PANEL),
]
Size = Annotated[
    int | None, typer.Option(help="Side of the photographs (pixels); by default 224.", rich_help_panel=_PANEL)
]
Network = Annotated[
    str | None,
    typer.Option(
        "--network",
        help="Name of the network in timm, or package.module:function.",
        rich_help_panel=_PANEL,
    ),
]
Weights = Annotated[
    Path | None, typer.Option(help="File of its weights: .safetensors, .pth or .npz.", rich_help_panel=_PANEL)
]
Pretrained = Annotated[
    bool, typer.Option("--pretrained", help="Use published weights from timm's hub.", rich_help_panel=_PANEL)
]
Outputs = Annotated[
    Literal["classes", "imagenet", "all_imagenet"],
    typer.Option(help="Outputs of the network: the folder's classes, or ImageNet's.", rich_help_panel=_PANEL),
]
Arguments = Annotated[
    list[str] | None,
    typer.Option(
        "--argument", help="Argument of timm's create_model, or of the function: img_size=64.", rich_help_panel=_PANEL
    ),
]


def network_settings(
    name: str, weights: Path | None, pretrained: bool, outputs: str, arguments: Sequence[str] | None
) -> dict[str, Any]:
    """Return the section of a study for a network; raises InputError if it has no weights."""
    if (weights is None) != pretrained and not is_users(name):
        raise InputError(f"--network {name}: give one of --weights FILE, --pretrained")
    if weights is not None and not weights.is_file():
        raise InputError(f"--weights {weights}: no such file")
    network = {"model": name, "outputs": outputs, "arguments": nested(arguments or (), "--argument")}
    return network | {"weights": None if weights is None else str(weights), "pretrained": pretrained}


def nested(texts: Sequence[str], option: str) -> dict[str, Any]:
    """Return settings KEY=VALUE as nested mappings: a.b=1 is {"a": {"b": 1}}; raises InputError."""
    settings: dict[str, Any] = {}
    for assignment in texts:
        key, equals, text = assignment.partition("=")
        *outer, last = key.split(".")
        inner = settings
        for name in outer:
            inner = inner.setdefault(name, {})
            if not isinstance(inner, dict):
                raise InputError(f"{option} {assignment}: {name} has the value {inner} from another {option}")
        if isinstance(inner.get(last), dict):
            raise InputError(f"{option} {assignment}: {last} has the values {inner[last]} from another {option}")
        try:
            inner[last] = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError):  # no date of the calendar
            equals = ""
        if not equals or not all((*outer, last)):
            raise InputError(f"{option} {assignment}: expected KEY=VALUE, such as descents.0.steps=200")
    return settings
