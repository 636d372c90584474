"""`tasklens lens captures`: captures of a folder of photographs."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from tasklens.cli.lens import Colour, File, FullWell, Rays
from tasklens.cli.lens_options import Seed
from tasklens.cli.outputs import remarks_about, say
from tasklens.cli.progress_bars import progress_bars


def captures(
    read: Callable,
    file: File,
    folder: Annotated[Path, typer.Argument(help="Folder of photographs, at any depth.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder of the captures.", show_default=False)],
    size: Annotated[int, typer.Option(min=8, help="Side of the captures (pixels).")] = 224,
    field: Annotated[Literal["random", "axis", "middle", "corner"], typer.Option(help="Field of each.")] = "random",
    seed: Seed = 0,
    colour: Colour = None,
    full_well: FullWell = None,
    rays: Rays = 4096,
) -> None:
    """Simulate captures of all photographs of a folder, each at one field, to train a network elsewhere."""
    from tasklens.api.folder_captures import FIELDS, capture_folder
    from tasklens.settings.capture_settings import SensorSettings

    lens = read(file)
    index = None if field == "random" else lens.view.named_fields[field]
    sensor = None if full_well is None else SensorSettings(full_well=full_well)
    with progress_bars(), remarks_about(file):
        count = capture_folder(folder, output, lens.lens, lens.view, size, index, seed, colour, sensor, rays)
    say(f"wrote {count} captures to {output}; {FIELDS} has their fields")
