"""Options of the commands that have a network and photographs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import yaml

from tasklens.runtime.errors import InputError
from tasklens.runtime.user_code import is_users

PANEL = "Network and photographs"  # of their options in the help


@dataclass(frozen=True)
class PhotographOptions:
    """A folder of photographs."""

    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of photographs: <class>/*, or train/<class>/* and test/<class>/*.", rich_help_panel=PANEL
        ),
    ] = None
    size: Annotated[
        int | None, typer.Option(help="Side of the photographs (pixels); by default 224.", rich_help_panel=PANEL)
    ] = None


@dataclass(frozen=True)
class NetworkOptions:
    """A network with its weights."""

    network: Annotated[
        str | None,
        typer.Option(help="Name of the network in timm, or package.module:function.", rich_help_panel=PANEL),
    ] = None
    weights: Annotated[
        Path | None, typer.Option(help="File of its weights: .safetensors, .pth or .npz.", rich_help_panel=PANEL)
    ] = None
    pretrained: Annotated[
        bool, typer.Option("--pretrained", help="Use published weights from timm's hub.", rich_help_panel=PANEL)
    ] = False
    outputs: Annotated[
        Literal["classes", "imagenet", "all_imagenet"],
        typer.Option(help="Outputs of the network: the folder's classes, or ImageNet's.", rich_help_panel=PANEL),
    ] = "classes"
    argument: Annotated[
        list[str] | None,
        typer.Option(help="Argument of timm's create_model, or of the function: img_size=64.", rich_help_panel=PANEL),
    ] = None

    def settings(self) -> dict[str, Any] | None:
        """Return the section of a study for the network, None for none; raises InputError if it has no weights."""
        if self.network is None:
            if self.weights or self.pretrained or self.outputs != "classes" or self.argument:
                raise InputError("--weights, --pretrained, --outputs, --argument: only with --network NAME")
            return None
        if (self.weights is None) != self.pretrained and not is_users(self.network):
            raise InputError(f"--network {self.network}: give one of --weights FILE, --pretrained")
        if self.weights is not None and not self.weights.is_file():
            raise InputError(f"--weights {self.weights}: no such file")
        return {
            "model": self.network,
            "outputs": self.outputs,
            "arguments": parse_settings(self.argument or (), "--argument"),
            "weights": None if self.weights is None else str(self.weights),
            "pretrained": self.pretrained,
        }


def parse_settings(texts: Sequence[str], option: str) -> dict[str, Any]:
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
