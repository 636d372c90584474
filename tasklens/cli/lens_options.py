"""Options of every command that reads lenses."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tasklens.cli.outputs import say

if TYPE_CHECKING:
    from tasklens.optics.io.lens_files import LensFile

_PANEL = "Overrides, and values missing from the file"


FieldOfView = Annotated[float | None, typer.Option(help="Full field of view (degrees).", rich_help_panel=_PANEL)]
FNumber = Annotated[
    float | None, typer.Option(help="F-number: focal length / diameter of the entrance pupil.", rich_help_panel=_PANEL)
]
PixelPitch = Annotated[float | None, typer.Option(help="Pixel pitch (um).", rich_help_panel=_PANEL)]
KernelSize = Annotated[int | None, typer.Option(help="Width of the PSF window (pixels, odd).", rich_help_panel=_PANEL)]
Wavelengths = Annotated[
    str | None,
    typer.Option(help="Wavelengths (um), the reference in the middle: 0.65,0.55,0.47.", rich_help_panel=_PANEL),
]
Focus = Annotated[
    str | None,
    typer.Option(
        help="Image plane: file, as in the file; mtf or best, at the peak of the MTF, the default with another object "
        "distance; spot, at the smallest spot; or its shift away from the lens (um).",
        rich_help_panel=_PANEL,
    ),
]
ObjectDistance = Annotated[
    float | None,
    typer.Option("--object-distance", help="Distance of the object (mm), or inf.", rich_help_panel=_PANEL),
]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of all random numbers.")]
Catalogues = Annotated[
    list[Path] | None, typer.Option(help="Glass catalogue of a .zmx file (.agf or YAML).", rich_help_panel=_PANEL)
]

Configuration = Annotated[
    int | None, typer.Option(help="Configuration number, if the .zmx file has several.", rich_help_panel=_PANEL)
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
