"""`tasklens lens simulate` and `captures`: captures of one image, and of a folder of photographs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import tasklens
from tasklens.cli.lens_commands import Diffraction, File, Rays
from tasklens.cli.options import Seed, reader, with_options
from tasklens.cli.outputs import Force, new_file, progress_bars, remarks_about, say
from tasklens.runtime.errors import InputError

if TYPE_CHECKING:
    from tasklens.optics.view import View

Colour = Annotated[
    Literal["srgb", "linear"] | None,
    typer.Option(help="Blur sRGB values, or linear light, the default with --full-well.", show_default="srgb"),
]
FullWell = Annotated[
    float | None,
    typer.Option(
        min=1, max=1e9, help="Add sensor noise: electrons per pixel at white, about 6000 in a phone in daylight."
    ),
]


@dataclass(frozen=True)
class WholeSensorOptions:
    """A capture of the whole sensor."""

    whole_sensor: Annotated[
        bool,
        typer.Option(
            "--whole-sensor", help="Simulate the whole sensor, from axis to corner; --kernel-size has no effect."
        ),
    ] = False
    true_pixels: Annotated[
        bool,
        typer.Option(
            "--true-pixels",
            help="With --whole-sensor: one image pixel per sensor pixel; by default the image fills it.",
        ),
    ] = False
    distortion: Annotated[
        bool, typer.Option("--distortion", help="With --whole-sensor: apply the distortion of the lens.")
    ] = False
    illumination: Annotated[
        bool, typer.Option("--illumination", help="With --whole-sensor: apply the relative illumination.")
    ] = False


@with_options(read=reader, sensor=WholeSensorOptions)
def simulate(
    read: Callable,
    file: File,
    image: Annotated[Path, typer.Argument(help="Image: JPEG, PNG or WebP.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Capture: .png or .jpg.", show_default=False)],
    *,
    field: Annotated[str, typer.Option(help="Field: axis, middle, corner, or X,Y: f tan(theta) in mm.")] = "axis",
    grid: Annotated[bool, typer.Option("--grid", help="Show all nine fields in one image.")] = False,
    sensor: WholeSensorOptions,
    colour: Colour = None,
    full_well: FullWell = None,
    rays: Rays = 4096,
    diffraction: Diffraction = False,
    force: Force = False,
) -> None:
    """Simulate the capture of an image at one field, or with --whole-sensor over the whole sensor."""
    from tasklens.settings.capture_settings import SensorSettings
    from tasklens.show import image_files

    new_file(output, force, ".png", ".jpg", ".jpeg")
    if grid and field != "axis":
        raise InputError("--grid shows all fields: not with --field")
    if sensor.whole_sensor and (grid or full_well is not None or diffraction or field != "axis"):
        raise InputError("--whole-sensor: not with --field, --grid, --full-well or --diffraction")
    if not sensor.whole_sensor and (sensor.true_pixels or sensor.distortion or sensor.illumination):
        raise InputError("--true-pixels, --distortion and --illumination: only with --whole-sensor")
    lens = read(file)
    if sensor.whole_sensor:
        pitch = lens.view.pixel_pitch_um if sensor.true_pixels else None
        options: Any = {
            "colour": colour or "srgb",
            "distortion": sensor.distortion,
            "illumination": sensor.illumination,
            "rays": rays,
        }
        with progress_bars(), remarks_about(file):
            captures = tasklens.simulate_whole_sensor(lens.lens, lens.view, image, pitch, **options)[None]
        say(f"{image}: pixels of {pitch:g} um" if pitch else f"{image}: scaled to fill the sensor")
    else:
        with remarks_about(file):
            captures = tasklens.simulate(
                lens.lens,
                lens.view,
                image,
                None if grid else [_field(lens.view, field)],
                colour=colour,
                sensor=None if full_well is None else SensorSettings(full_well=full_well),
                rays=rays,
                diffraction=diffraction,
            )
    image_files.write_captures(output, captures)
    say(f"wrote {output}")


@with_options(read=reader)
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
    from tasklens.api.captures import FIELDS, capture_folder
    from tasklens.settings.capture_settings import SensorSettings

    lens = read(file)
    index = None if field == "random" else lens.view.named_fields[field]
    sensor = None if full_well is None else SensorSettings(full_well=full_well)
    with progress_bars(), remarks_about(file):
        count = capture_folder(folder, output, lens.lens, lens.view, size, index, seed, colour, sensor, rays)
    say(f"wrote {count} captures to {output}; {FIELDS} has their fields")


def _field(view: "View", name: str) -> tuple[float, float]:
    """Return the point [mm] of a field by its name, or from X,Y; raises InputError."""
    if (field := view.named_fields.get(name)) is not None:
        x, y = view.fields[field].tolist()
        return x, y
    try:
        x, y = map(float, name.split(","))
    except ValueError:
        raise InputError(
            f"--field {name}: expected axis, middle, corner, or X,Y in millimetres such as 0.9,0.5"
        ) from None
    return x, y
