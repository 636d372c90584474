"""Options that several commands share, and groups of options as one parameter of a command."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
import yaml

from tasklens.cli.outputs import say
from tasklens.runtime.errors import InputError
from tasklens.runtime.user_code import is_users

if TYPE_CHECKING:
    from tasklens.optics.io.lens_files import LensFile

PANEL = "Network and photographs"  # of their options in the help
_LENS = "Overrides, and values missing from the file"

FieldOfView = Annotated[float | None, typer.Option(help="Full field of view (degrees).", rich_help_panel=_LENS)]
FNumber = Annotated[
    float | None,
    typer.Option(help="F-number: focal length / diameter of the entrance pupil.", rich_help_panel=_LENS),
]
PixelPitch = Annotated[float | None, typer.Option(help="Pixel pitch (um).", rich_help_panel=_LENS)]
KernelSize = Annotated[int | None, typer.Option(help="Width of the PSF window (pixels, odd).", rich_help_panel=_LENS)]
Wavelengths = Annotated[
    str | None,
    typer.Option(help="Wavelengths (um), the reference in the middle: 0.65,0.55,0.47.", rich_help_panel=_LENS),
]
Focus = Annotated[
    str | None,
    typer.Option(
        help="Image plane: file, as in the file; mtf or best, at the peak of the MTF, the default with another object "
        "distance; spot, at the smallest spot; or its shift away from the lens (um).",
        rich_help_panel=_LENS,
    ),
]
ObjectDistance = Annotated[
    float | None,
    typer.Option("--object-distance", help="Distance of the object (mm), or inf.", rich_help_panel=_LENS),
]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of all random numbers.")]
Catalogues = Annotated[
    list[Path] | None, typer.Option(help="Glass catalogue of a .zmx file (.agf or YAML).", rich_help_panel=_LENS)
]
Configuration = Annotated[
    int | None, typer.Option(help="Configuration number, if the .zmx file has several.", rich_help_panel=_LENS)
]


def reader(
    field_of_view: FieldOfView = None,
    f_number: FNumber = None,
    pixel_pitch: PixelPitch = None,
    kernel_size: KernelSize = None,
    wavelengths: Wavelengths = None,
    focus: Focus = None,
    object_distance: ObjectDistance = None,
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
            object_distance,
            configuration,
            colours,
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


def _focus(text: str) -> str | float:
    """Return a name of a focus, or a shift [um]; `best` is an older name of `mtf`."""
    try:
        return float(text)
    except ValueError:
        return "mtf" if text == "best" else text


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


def with_options(**groups: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that replaces parameters of a command by groups of options.

    Args:
        groups: by parameter, a data class or a function whose parameters are options, as typer declares them. The
            command gets the object, or what the function returns.
    """
    options = {name: inspect.signature(group, eval_str=True).parameters for name, group in groups.items()}

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
