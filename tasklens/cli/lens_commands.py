"""`tasklens lens ...`: lenses in our lens.yaml or in Zemax's .zmx."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import tasklens
from tasklens.cli.options import Catalogues, Configuration, FieldOfView, Seed, reader, with_options
from tasklens.cli.outputs import (
    AsJson,
    Force,
    new_catalogue,
    new_file,
    print_json,
    progress_bars,
    remarks_about,
    say,
    say_catalogue,
)
from tasklens.runtime.errors import InputError

app = typer.Typer(no_args_is_help=True)

File = Annotated[Path, typer.Argument(help="Lens: .yaml or .zmx.", show_default=False)]
Files = Annotated[list[Path], typer.Argument(help="Lenses: .yaml or .zmx.", show_default=False)]
_GRADE = "precision_moulding"
Rays = Annotated[int, typer.Option(min=1, help="Rays per field and colour.")]
Diffraction = Annotated[bool, typer.Option("--diffraction", help="Include diffraction; takes half a minute.")]
SensorFields = Annotated[
    bool, typer.Option("--sensor-fields", help="At nine fields over the sensor, also if the file has its own.")
]


@app.command()
@with_options(read=reader)
def show(
    read: Callable, files: Files, rays: Rays = 4096, sensor_fields: SensorFields = False, json: AsJson = False
) -> None:
    """Summarise lenses: elements, focal length, sharpness from axis to corner, tightest margin."""
    from tasklens.optics.analysis.datasheet import figures
    from tasklens.show import glance

    lenses = {str(path): read(path) for path in files}
    summaries = {
        name: glance.summary(
            item.lens, item.content, figures(item.lens, item.view if sensor_fields else item.own_view, rays)
        )
        for name, item in lenses.items()
    }
    if json:
        print_json(summaries)
    else:
        print("\n\n".join(glance.text(name, item) for name, item in summaries.items()))


@app.command()
@with_options(read=reader)
def compare(read: Callable, files: Files, rays: Rays = 4096, json: AsJson = False) -> None:
    """Compare lenses in one table, a row per lens."""
    from tasklens.optics.analysis.datasheet import figures
    from tasklens.show import glance

    lenses = {name: read(path) for name, path in _by_shortest_names(files, whole=json).items()}
    rows = [glance.row(name, lens.content, figures(lens.lens, lens.view, rays)) for name, lens in lenses.items()]
    if json:
        print_json(rows)
    else:
        print(glance.table(rows))


@app.command()
@with_options(read=reader)
def analyse(
    read: Callable, file: File, rays: Rays = 4096, sensor_fields: SensorFields = False, json: AsJson = False
) -> None:
    """Print all figures of a lens: first-order data, limits of a design, figures by field, aberrations by surface."""
    from tasklens.optics.analysis.datasheet import figures, seidel_by_surface
    from tasklens.show import certificate

    lens = read(file)
    view = lens.view if sensor_fields else lens.own_view
    content = {**lens.content, "figures": figures(lens.lens, view, rays)}
    by_surface = seidel_by_surface(lens.lens, view)
    if json:
        more = {"fields_mm": view.fields.tolist(), "seidel_by_surface_um": by_surface}
        print_json(content["figures"] | more | ({"margins": content["margins"]} if "margins" in content else {}))
    else:
        print(certificate.markdown(str(file), view.fields.tolist(), content, by_surface), end="")


@app.command()
@with_options(read=reader)
def draw(
    read: Callable,
    files: Files,
    output: Annotated[Path, typer.Option("--output", "-o", help="Drawing: .png, .svg or .pdf.", show_default=False)],
    rays: Rays = 4096,
    force: Force = False,
) -> None:
    """Draw lenses one above the other: cross-section with rays, spots, PSFs, ray fans, MTF, distortion."""
    from tasklens.show import figures
    from tasklens.show.panel import Panel

    new_file(output, force, ".png", ".svg", ".pdf")
    lenses = {name: read(path) for name, path in _by_shortest_names(files).items()}
    panels = [Panel.compute(name, lens.lens, lens.view, rays) for name, lens in lenses.items()]
    figures.save(figures.figure_of(panels), [output])
    say(f"wrote {output}")


@app.command()
@with_options(read=reader)
def tolerance(
    read: Callable,
    file: File,
    grade: Annotated[
        str, typer.Option(help="Grade: precision_moulding, commercial_moulding or phone_moulding.")
    ] = _GRADE,
    lenses: Annotated[int, typer.Option(min=10, help="Number of Monte Carlo lenses.")] = 200,
    seed: Seed = 0,
    json: AsJson = False,
) -> None:
    """Monte Carlo tolerancing: yield, worst offenders, and tolerances for a drawing."""
    from tasklens.optics.analysis import focus
    from tasklens.optics.tolerancing import yields
    from tasklens.settings.tolerance_settings import GRADES, Grade
    from tasklens.show import yield_tables as report

    if grade not in GRADES:
        raise InputError(f"--grade {grade}: expected one of {', '.join(GRADES)}")
    lens = read(file)
    with progress_bars():
        result = yields.tolerances(lens.lens, lens.view, Grade.model_validate(grade), lenses, seed)
    summary = report.summary(result, grade, focus.frequency(lens.view))
    if json:
        print_json(summary)
    else:
        print(report.text(str(file), summary))


@app.command()
@with_options(read=reader)
def psf(
    read: Callable,
    file: File,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="PSFs: .npz, .safetensors, or .png to view.", show_default=False)
    ],
    rays: Rays = 4096,
    diffraction: Diffraction = False,
    force: Force = False,
) -> None:
    """Compute the point spread functions at nine fields and each wavelength."""
    from tasklens.show import image_files

    new_file(output, force, ".npz", ".safetensors", ".png")
    lens = read(file)
    with remarks_about(file):
        grid = tasklens.psf(lens.lens, lens.view, rays, diffraction)
    image_files.write_psf(output, grid, lens.lens, lens.view)
    say(f"wrote {output}")


@app.command()
def export(
    file: File,
    output: Annotated[Path, typer.Option("--output", "-o", help="Lens: .zmx or .yaml.", show_default=False)],
    field_of_view: FieldOfView = None,
    catalogue: Catalogues = None,
    configuration: Configuration = None,
    force: Force = False,
) -> None:
    """Convert a lens between YAML and Zemax."""
    from tasklens.materials.library import user_files
    from tasklens.optics.io import lens_files, prescription
    from tasklens.optics.io.lens_specs import without_figures
    from tasklens.optics.io.zemax_glasses import NamedGlasses

    new_file(output, force, ".zmx", ".yaml", ".yml")
    lens_data, content = lens_files.read_prescription(file, [*(catalogue or ()), *user_files()], configuration)
    lacks_system_data = output.suffix.lower() == ".zmx" and not (lens_data.fields and lens_data.wavelengths_um)
    if field_of_view is not None or lacks_system_data:
        view = reader(field_of_view, catalogue=catalogue, configuration=configuration)(file).view
        if field_of_view is not None:
            lens_data = replace(lens_data, fields=None)
            if "spec" in content:
                diagonal = 2 * float(view.radii.max())
                spec = {"fields_mm": view.fields.tolist(), "field_of_view_deg": field_of_view, "diagonal_mm": diagonal}
                content = without_figures(content) | {"spec": content["spec"] | spec}
        lens_data = prescription.with_system_data(lens_data, view)
    else:
        for remark in lens_data.remarks:
            say(f"{file}: {remark}")
    media = lens_data.lens.media
    if output.suffix.lower() == ".zmx" and NamedGlasses.of(media, output.stem).own:
        new_catalogue(output, force)
    lens_files.write(output, lens_data, content)
    say(f"wrote {output}")
    say_catalogue(output, media)


def _by_shortest_names(files: list[Path], whole: bool = False) -> dict[str, Path]:
    """Return files by their shortest unique names: stem, file name, or `whole` path."""
    for name in () if whole else (lambda path: path.stem, lambda path: path.name):
        by_name = {name(path): path for path in files}
        if len(by_name) == len(set(files)):
            return by_name
    return {str(path): path for path in files}
