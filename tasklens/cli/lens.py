"""`tasklens lens ...`: lenses in a lens.yaml of ours, or in Zemax's .zmx."""

import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tasklens.cli.outputs import AsJson, Force, new_file, print_json, say
from tasklens.runtime.errors import InputError

if TYPE_CHECKING:
    from tasklens.optics.io.lens_files import LensFile
    from tasklens.optics.view import View

app = typer.Typer(no_args_is_help=True)

File = Annotated[Path, typer.Argument(help="Lens: .yaml or .zmx.", show_default=False)]
Files = Annotated[list[Path], typer.Argument(help="Lenses: .yaml or .zmx.", show_default=False)]
Rays = Annotated[int, typer.Option(min=1, help="Rays per field and colour.")]
_PANEL = "What differs from the file, or is not in it"


FieldOfView = Annotated[float | None, typer.Option(help="Full angle, degrees.", rich_help_panel=_PANEL)]
FNumber = Annotated[float | None, typer.Option(help="Focal length / pupil.", rich_help_panel=_PANEL)]
PixelPitch = Annotated[float | None, typer.Option(help="Micrometres.", rich_help_panel=_PANEL)]
KernelSize = Annotated[int | None, typer.Option(help="Width of PSFs, pixels, odd.", rich_help_panel=_PANEL)]
Wavelengths = Annotated[
    str | None, typer.Option(help="Red, green, blue in micrometres: 0.65,0.55,0.47.", rich_help_panel=_PANEL)
]
Focus = Annotated[
    float | None,
    typer.Option(help="Shift of the image plane away from the lens, micrometres.", rich_help_panel=_PANEL),
]
ObjectDistance = Annotated[
    float | None,
    typer.Option("--object", help="Distance of the object, millimetres; else at infinity.", rich_help_panel=_PANEL),
]
Catalogues = Annotated[
    list[Path] | None, typer.Option(help="Glass catalogue of a .zmx (.agf or YAML).", rich_help_panel=_PANEL)
]


def _reader(
    field_of_view: FieldOfView = None,
    f_number: FNumber = None,
    pixel_pitch: PixelPitch = None,
    kernel_size: KernelSize = None,
    wavelengths: Wavelengths = None,
    focus: Focus = None,
    object_distance: ObjectDistance = None,
    catalogue: Catalogues = None,
) -> Callable[[Path], "LensFile"]:
    """Return a function that reads lenses with these options."""
    from tasklens.optics.io import lens_files

    wanted = {
        "field_of_view_deg": field_of_view,
        "f_number": f_number,
        "pixel_pitch_um": pixel_pitch,
        "kernel_size": kernel_size,
        "wavelengths_um": wavelengths and tuple(wavelengths.split(",")),
    }

    def read(path: Path) -> "LensFile":
        found = lens_files.read(path, catalogue or (), object_distance, **wanted)
        for remark in found.remarks:
            say(f"{path}: {remark}")
        return _with_image_moved(found, focus) if focus else found

    return read


def _with_image_moved(found: "LensFile", shift: float) -> "LensFile":
    """Return a lens with its image plane `shift` micrometres further away; raises InputError."""
    if not math.isfinite(shift):
        raise InputError(f"--focus {shift}: expected a number of micrometres, such as -10")
    thickness = found.lens.thickness.clone()
    thickness[-1] += 1e-3 * shift
    return replace(found, lens=replace(found.lens, thickness=thickness))


def _command(function: Callable[..., None]) -> Callable[..., None]:
    """Add a command whose first parameter reads lenses; the options of `_reader` are its own too."""
    shared = inspect.signature(_reader, eval_str=True).parameters

    @wraps(function)
    def command(**given: Any) -> None:
        function(_reader(**{name: given.pop(name) for name in shared}), **given)

    own = list(inspect.signature(function, eval_str=True).parameters.values())[1:]
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *shared.values())]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # which typer reads
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    app.command()(command)
    return command


@_command
def show(read: Callable, files: Files, rays: Rays = 4096, json: AsJson = False) -> None:
    """Say at a glance what lenses are: elements, focal length, sharpness from axis to corner, worst limit."""
    from tasklens.optics.analysis.datasheet import figures
    from tasklens.report import glance

    found = {str(path): read(path) for path in files}
    shown = {
        name: glance.summary(each.lens, each.content, figures(each.lens, each.view, rays))
        for name, each in found.items()
    }
    if json:
        print_json(shown)
    else:
        print("\n\n".join(glance.text(name, each) for name, each in shown.items()))


@_command
def compare(read: Callable, files: Files, rays: Rays = 4096, json: AsJson = False) -> None:
    """Compare lenses: a row for each, in one table."""
    from tasklens.optics.analysis.datasheet import figures
    from tasklens.report import glance

    found = {name: read(path) for name, path in _named(files, whole=json).items()}
    rows = [glance.row(name, each.content, figures(each.lens, each.view, rays)) for name, each in found.items()]
    if json:
        print_json(rows)
    else:
        print(glance.table(rows))


@_command
def analyse(read: Callable, file: File, rays: Rays = 4096, json: AsJson = False) -> None:
    """Print all figures of a lens: first-order data, figures by field, aberrations by surface."""
    from tasklens.optics.analysis.datasheet import figures, seidel_by_surface
    from tasklens.report import certificate

    found = read(file)
    computed = {**found.content, "figures": figures(found.lens, found.view, rays)}
    by_surface = seidel_by_surface(found.lens, found.view)
    if json:
        print_json(computed["figures"] | {"fields_mm": found.view.fields.tolist(), "seidel_by_surface_um": by_surface})
    else:
        print(certificate.markdown(str(file), found.view.fields.tolist(), computed, by_surface), end="")


@_command
def draw(
    read: Callable,
    files: Files,
    output: Annotated[Path, typer.Option("--output", "-o", help="Drawing: .png, .svg or .pdf.", show_default=False)],
    rays: Rays = 4096,
    force: Force = False,
) -> None:
    """Draw lenses one above the other: cross-section with rays, spots, PSFs, ray fans."""
    from tasklens.report import drawing

    new_file(output, force, ".png", ".svg", ".pdf")
    drawing.draw(output, {name: read(path) for name, path in _named(files).items()}, rays)
    say(f"wrote {output}")


@_command
def psf(
    read: Callable,
    file: File,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="PSFs: .npz, .safetensors, or a .png to look at.", show_default=False)
    ],
    rays: Rays = 4096,
    diffraction: Annotated[bool, typer.Option("--diffraction", help="With diffraction: half a minute.")] = False,
    force: Force = False,
) -> None:
    """Compute the point spread functions at nine fields in three colours."""
    from tasklens import notebook
    from tasklens.report import image_files

    new_file(output, force, ".npz", ".safetensors", ".png")
    found = read(file)
    image_files.write_psf(output, notebook.psf(found.lens, found.view, rays, diffraction), found.lens, found.view)
    say(f"wrote {output}")


@_command
def simulate(
    read: Callable,
    file: File,
    image: Annotated[Path, typer.Argument(help="Image: JPEG, PNG or WebP.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Capture: .png or .jpg.", show_default=False)],
    field: Annotated[str, typer.Option(help="axis, middle, corner, or X,Y on the sensor in millimetres.")] = "axis",
    grid: Annotated[bool, typer.Option("--grid", help="All nine fields in one picture.")] = False,
    sensor: Annotated[bool, typer.Option("--sensor", help="As the whole sensor sees it, from axis to corner.")] = False,
    true_pixels: Annotated[
        bool,
        typer.Option("--true-pixels", help="Pixels of the image are the sensor's, with --sensor; else it fills it."),
    ] = False,
    distortion: Annotated[bool, typer.Option("--distortion", help="Of the lens, with --sensor.")] = False,
    illumination: Annotated[bool, typer.Option("--illumination", help="Darker corners, with --sensor.")] = False,
    colour: Annotated[Literal["srgb", "linear"], typer.Option(help="Convolve values, or light.")] = "srgb",
    noise: Annotated[bool, typer.Option("--noise", help="With the noise of a phone's sensor in daylight.")] = False,
    rays: Rays = 4096,
    diffraction: Annotated[bool, typer.Option("--diffraction", help="With diffraction: half a minute.")] = False,
    force: Force = False,
) -> None:
    """Show what the sensor sees of an image, as if all of it lay at one field, or with --sensor all of it."""
    from tasklens import notebook
    from tasklens.report import image_files
    from tasklens.study.settings import SensorSettings

    new_file(output, force, ".png", ".jpg", ".jpeg")
    if sensor and (grid or noise or diffraction or field != "axis"):
        raise InputError("--sensor: not with --field, --grid, --noise or --diffraction")
    if not sensor and (true_pixels or distortion or illumination):
        raise InputError("--true-pixels, --distortion and --illumination: only with --sensor")
    found = read(file)
    if sensor:
        pitch = found.view.pixel_pitch if true_pixels else None
        how: Any = {"colour": colour, "distortion": distortion, "illumination": illumination, "rays": rays}
        captures = notebook.simulate_sensor(image, found.lens, found.view, pitch, **how)[None]
        say(f"{image}: in pixels of {pitch:g} um" if pitch else f"{image}: as if it filled the sensor")
    else:
        captures = notebook.simulate(
            image,
            found.lens,
            found.view,
            None if grid else [_field(found.view, field)],
            colour=colour,
            sensor=SensorSettings() if noise else None,
            rays=rays,
            diffraction=diffraction,
        )
    image_files.write_captures(output, captures)
    say(f"wrote {output}")


@app.command()
def export(
    file: File,
    output: Annotated[Path, typer.Option("--output", "-o", help="Lens: .zmx or .yaml.", show_default=False)],
    field_of_view: FieldOfView = None,
    catalogue: Catalogues = None,
    force: Force = False,
) -> None:
    """Convert a lens for Zemax, or from Zemax to YAML."""
    from tasklens.optics.io import lens_files, prescription, zemax

    new_file(output, force, ".zmx", ".yaml", ".yml")
    found, content = lens_files.read_prescription(file, catalogue or ())
    if output.suffix.lower() == ".zmx" and not (found.fields and found.wavelengths_um):
        found = prescription.with_use(found, _reader(field_of_view, catalogue=catalogue)(file).view)
    own = zemax.own_materials(found) if output.suffix.lower() == ".zmx" else {}
    if own:
        beside = new_file(output.with_suffix(".agf"), force, ".agf")
    lens_files.write(output, found, content)
    say(f"wrote {output}")
    if own:
        say(f"wrote {beside} with {', '.join(own)}, for OpticStudio's folder Glasscat")


def _named(files: list[Path], whole: bool = False) -> dict[str, Path]:
    """Return files by names as short as tells them apart: stem, file name, or `whole` path."""
    for name in () if whole else (lambda path: path.stem, lambda path: path.name):
        found = {name(path): path for path in files}
        if len(found) == len(set(files)):
            return found
    return {str(path): path for path in files}


def _field(view: "View", name: str) -> tuple[float, float]:
    """Return the point [mm] of a field by its name, or from X,Y inside the largest field; raises InputError."""
    order = view.radii.argsort().tolist()
    named = {"axis": order[0], "middle": order[len(order) // 2], "corner": order[-1]}
    if name in named:
        x, y = view.fields[named[name]].tolist()
        return x, y
    try:
        x, y = (float(word) for word in name.split(","))
    except ValueError:
        raise InputError(
            f"--field {name}: expected axis, middle, corner, or X,Y in millimetres such as 0.9,0.5"
        ) from None
    if not math.hypot(x, y) <= (largest := float(view.radii.max())) * (1 + 1e-3):
        raise InputError(f"--field {name}: outside the field, which ends {largest:.3f} mm from the axis")
    return x, y
