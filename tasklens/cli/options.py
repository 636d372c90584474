"""Options that several commands share, and groups of options as one parameter of a command."""

import inspect
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

import typer
import yaml

from tasklens.cli.outputs import say
from tasklens.runtime.errors import InputError
from tasklens.runtime.user_code import is_users

if TYPE_CHECKING:
    from tasklens.optics.io.lens_files import LensFile

PANEL = "Network and photographs"  # of their options in the help
_LENS = "Overrides, and values missing from the file"

Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of all random numbers.")]
FieldOfView = Annotated[float | None, typer.Option(help="Full field of view (degrees).", rich_help_panel=_LENS)]
Catalogues = Annotated[
    list[Path] | None, typer.Option(help="Glass catalogue of a .zmx file (.agf or YAML).", rich_help_panel=_LENS)
]
Configuration = Annotated[
    int | None, typer.Option(help="Configuration number, if the .zmx file has several.", rich_help_panel=_LENS)
]


def reader(
    field_of_view: FieldOfView = None,
    f_number: Annotated[
        float | None, typer.Option(help="F-number: focal length / diameter of the entrance pupil.")
    ] = None,
    pixel_pitch: Annotated[float | None, typer.Option(help="Pixel pitch (um).")] = None,
    kernel_size: Annotated[int | None, typer.Option(help="Width of the PSF window (pixels, odd).")] = None,
    wavelengths: Annotated[
        str | None, typer.Option(help="Wavelengths (um), the reference in the middle: 0.65,0.55,0.47.")
    ] = None,
    focus: Annotated[
        str | None,
        typer.Option(
            help="Image plane: file, as in the file; mtf or best, at the peak of the MTF, the default with another "
            "object distance; spot, at the smallest spot; or its shift away from the lens (um)."
        ),
    ] = None,
    object_distance: Annotated[float | None, typer.Option(help="Distance of the object (mm), or inf.")] = None,
    catalogue: Catalogues = None,
    configuration: Configuration = None,
) -> Callable[[Path], "LensFile"]:
    """Return a function that reads lenses with these options."""
    from tasklens.materials.library import user_files
    from tasklens.optics.io import lens_files

    files = [*(catalogue or ()), *user_files()]
    colours = None if wavelengths is None else wavelengths.split(",")

    def read(path: Path) -> "LensFile":
        file = lens_files.read(
            path,
            files,
            configuration,
            object_distance_mm=object_distance,
            wavelengths_um=colours,
            field_of_view_deg=field_of_view,
            f_number=f_number,
            pixel_pitch_um=pixel_pitch,
            kernel_size=kernel_size,
            focus=None if focus is None else _focus(focus),
        )
        for remark in file.remarks:
            say(f"{path}: {remark}")
        return file

    return read


reader.panel = _LENS  # type: ignore[attr-defined]  # `with_options` reads it


def _focus(text: str) -> str | float:
    """Return a name of a focus, or a shift [um]; `best` is an older name of `mtf`."""
    try:
        return float(text)
    except ValueError:
        return "mtf" if text == "best" else text


@dataclass(frozen=True)
class PhotographOptions:
    """A folder of photographs."""

    panel: ClassVar[str] = PANEL
    images: Annotated[
        Path | None, typer.Option(help="Folder of photographs: <class>/*, or train/<class>/* and test/<class>/*.")
    ] = None
    size: Annotated[int | None, typer.Option(help="Side of the photographs (pixels); by default 224.")] = None


@dataclass(frozen=True)
class NetworkOptions:
    """A network with its weights."""

    panel: ClassVar[str] = PANEL
    network: Annotated[str | None, typer.Option(help="Name of the network in timm, or package.module:function.")] = None
    weights: Annotated[Path | None, typer.Option(help="File of its weights: .safetensors, .pth or .npz.")] = None
    pretrained: Annotated[bool, typer.Option("--pretrained", help="Use published weights from timm's hub.")] = False
    outputs: Annotated[
        Literal["classes", "imagenet", "all_imagenet"],
        typer.Option(help="Outputs of the network: the folder's classes, or ImageNet's."),
    ] = "classes"
    argument: Annotated[
        list[str] | None, typer.Option(help="Argument of timm's create_model, or of the function: img_size=64.")
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


def with_options(**groups: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that replaces parameters of a command by groups of options.

    Args:
        groups: by parameter, a data class or a function whose parameters are options, as typer declares them, in the
            `panel` of the help that it names. The command gets the object, or what the function returns.
    """
    options = {name: _options(group) for name, group in groups.items()}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters

        @wraps(command)
        def grouped(**values: Any) -> None:
            for name, group in groups.items():
                values[name] = group(**{option: values.pop(option) for option in options[name]})
            command(**values)

        parameters = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for name in own
            for parameter in (options[name].values() if name in options else [own[name]])
        ]
        grouped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
        grouped.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return grouped

    return decorate


def _options(group: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the options of a group by name, each in its panel of the help."""
    options = dict(inspect.signature(group, eval_str=True).parameters)
    for name, parameter in options.items():
        kind, option = get_args(parameter.annotation)
        if option.rich_help_panel is None:
            option = copy(option)
            option.rich_help_panel = getattr(group, "panel", None)
            options[name] = parameter.replace(annotation=Annotated[kind, option])
    return options
