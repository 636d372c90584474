"""`tasklens design`: one lens without a study."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from tasklens.cli.lens_options import Seed
from tasklens.cli.network_options import (
    Arguments,
    Images,
    Network,
    Outputs,
    Pretrained,
    SaveNetwork,
    Size,
    Weights,
    nested,
    network_settings,
)
from tasklens.cli.outputs import AsJson, Force, new_catalogue, new_file, print_json, remarks_about, say, say_catalogue
from tasklens.cli.progress_bars import progress_bars
from tasklens.runtime.errors import InputError

_SPEC = "Specification (with --start: overrides of the file)"
_METHOD = (
    "Design method: least_squares (the default), spot (the default with --start), contrast, "
    "log_image_error, correlation; with a network: task, joint, end_to_end."
)
_START = "Start from a lens file"
_VERDICT = "Verdict"


def design(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File of the lens, .yaml or .zmx.", show_default=False)
    ],
    elements: Annotated[
        str | None,
        typer.Option(help="Materials from front to back, by default COC,OKP4."),
    ] = None,
    method: Annotated[str | None, typer.Option(help=_METHOD, show_default=False)] = None,
    seed: Seed = 0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Setting of the method, as in a study: evaluations=2000, descents.0.steps=200."),
    ] = None,
    limits: Annotated[
        list[str] | None, typer.Option("--limit", help="Limit, a key of `constraints` in a study: max_track=6.")
    ] = None,
    catalogue: Annotated[
        list[Path] | None, typer.Option(help="File of further glasses (.agf) or plastics (.yaml).")
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            help="Lens to improve, .zmx or .yaml; its glasses stay. flat: plane-parallel plates, as in the paper, with "
            "the schedule of the studies (task, log_image_error, correlation): as accurate as from imaging lenses, the "
            "default (97.5 and 97.6 % on textures, one seed), in up to five times as many steps.",
            rich_help_panel=_START,
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            help="Free variables and surfaces, numbered from 0: curvature,thickness:1+3,alpha_4..10.",
            rich_help_panel=_START,
        ),
    ] = None,
    configuration: Annotated[
        int | None, typer.Option(help="Configuration number, if the .zmx file has several.", rich_help_panel=_START)
    ] = None,
    object_distance: Annotated[
        float | None,
        typer.Option("--object-distance", help="Only inf: move the file's object to infinity.", rich_help_panel=_START),
    ] = None,
    f_number: Annotated[float | None, typer.Option(help="F-number; by default 2.8.", rich_help_panel=_SPEC)] = None,
    field_of_view: Annotated[
        float | None, typer.Option(help="Full field of view (degrees); by default 68.8.", rich_help_panel=_SPEC)
    ] = None,
    diagonal: Annotated[
        float | None, typer.Option(help="Diagonal of the sensor (mm); by default 4.", rich_help_panel=_SPEC)
    ] = None,
    pixel_pitch: Annotated[
        float | None, typer.Option(help="Pixel pitch (um); by default 1.8.", rich_help_panel=_SPEC)
    ] = None,
    kernel_size: Annotated[
        int | None, typer.Option(help="Width of the PSF window (pixels); by default 51.", rich_help_panel=_SPEC)
    ] = None,
    wavelengths: Annotated[
        str | None, typer.Option(help="Wavelengths (um); by default 0.6563,0.5893,0.4861.", rich_help_panel=_SPEC)
    ] = None,
    images: Images = None,
    size: Size = None,
    network: Network = None,
    weights: Weights = None,
    pretrained: Pretrained = False,
    outputs: Outputs = "classes",
    argument: Arguments = None,
    save_network: SaveNetwork = None,
    verdict: Annotated[
        bool, typer.Option(help="Compare the lens of `task` with lenses for image quality.", rich_help_panel=_VERDICT)
    ] = True,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Design one lens. A least-squares doublet takes a minute; `task` starts from the better of two imaging lenses.

    tasklens design --elements COC,OKP4 --f-number 2.8 -o doublet.yaml

    tasklens design --method task --images photographs --network resnet18 --weights mine.safetensors -o mine.yaml

    tasklens design --start mine.zmx --method contrast --free curvature,thickness -o better.zmx
    """
    from tasklens.settings.lens_settings import TRAINING

    from_flat = start == Path("flat")
    start = None if from_flat else start
    new_file(output, force, ".yaml", ".yml", ".zmx")
    if output.suffix.lower() == ".zmx":
        new_catalogue(output, force)
    if start is not None and (elements, diagonal) != (None, None):
        raise InputError("--elements, --diagonal: not allowed with --start, since its lens has them")
    if start is None and (free, configuration, object_distance) != (None, None, None):
        raise InputError("--free, --configuration, --object-distance: only with --start FILE")
    if save_network is not None:
        new_file(save_network, force, ".safetensors")
        if method not in TRAINING:
            raise InputError("--save-network: only with --method joint or end_to_end, which train the network")
    spec = {
        "f_number": f_number,
        "field_of_view_deg": field_of_view,
        "diagonal_mm": diagonal,
        "pixel_pitch_um": pixel_pitch,
        "kernel_size": kernel_size,
        "wavelengths_um": wavelengths and wavelengths.split(","),
        "configuration": configuration,
        "object_distance_mm": object_distance,
    }
    classifier = None
    if network is None and (weights or pretrained or outputs != "classes" or argument):
        raise InputError("--weights, --pretrained, --outputs, --argument: only with --network NAME")
    if network is not None:
        classifier = network_settings(network, weights, pretrained, outputs, argument)
        if method in TRAINING and save_network is None:
            raise InputError(f"--method {method}: trains the network with the lens; give --save-network FILE for it")
    method_settings, constraint_settings = nested(settings or (), "--set"), nested(limits or (), "--limit")
    from tasklens.design import single
    from tasklens.optics.io import lens_files
    from tasklens.report import glance
    from tasklens.runtime.files import write_tensors

    test_images, page = None, output.with_suffix(".html")
    if verdict and method == "task" and images is not None and network is not None:
        new_file(page, force, ".html")
        test_images = single.unused_images(images, size)
    with progress_bars(), _keys_as_options():
        result = single.designs(
            method,
            elements and elements.split(","),
            seed=seed,
            start="flat" if from_flat else start,
            free=None if free is None else _free(free),
            settings=method_settings,
            constraints=constraint_settings,
            catalogues=catalogue or (),
            images=images,
            size=size,
            network=classifier,
            held_out=True,
            baselines=() if test_images is None else single.BASELINES,
            spec=spec,
            remark=lambda text: say(f"{start}: {text}"),
        )
    lens, notes = result.lens, result.notes
    dark = sum(not math.isfinite(radius) for radius in notes["figures"]["rms_centroid_um"])
    if dark:
        hint = "take fewer steps, or smaller ones" if start is not None else "try another --seed"
        raise InputError(f"no light arrives at {dark} of the design's fields; nothing is written: {hint}")
    if save_network is not None:
        assert result.trained_weights is not None  # by these methods
        write_tensors(save_network, result.trained_weights, {"lens": str(output)})
        say(f"wrote {save_network}")
    if result.remark:
        say(f"{output}: {result.remark}")
    lens_files.write(output, result.prescription, notes)
    say_catalogue(output, lens.media)
    summary = glance.summary(lens, notes, notes["figures"]) | {"file": str(output)}
    if test_images is not None:
        from tasklens.api.verdict import verdict as judged

        with progress_bars(), remarks_about(output):
            answer, ranking = judged(result, test_images)
        ranking.save(page, "Lens comparison", [answer])
        summary |= {"verdict": answer, "page": str(page)}
    if json:
        print_json(summary)
        return
    print(glance.text(str(output), summary))
    if test_images is not None:
        print(f"\n{summary['verdict']}\nThe page: {page}")


@contextmanager
def _keys_as_options() -> Iterator[None]:
    """Replace keys of a study by options of this command in error messages."""
    try:
        yield
    except InputError as error:
        text = re.sub(r"\bconstraints\.(\w+)", r"--limit \1", str(error))
        text = re.sub(r"^(?:classifiers\.)?network: ", "--network ", text)
        text = re.sub(r"\bspec\.(\w+?)(?:_deg|_mm|_um)?\b", lambda key: f"--{key[1].replace('_', '-')}", text)
        raise InputError(text) from None


def _free(text: str) -> dict[str, tuple[int, ...] | None]:
    """Parse variables and their surfaces: NAME or NAME:0+1+3, separated by commas; alpha_4..8 means several.

    Raises:
        InputError: the text has another form.
    """
    free: dict[str, tuple[int, ...] | None] = {}
    for part in text.split(","):
        name, colon, numbers = part.strip().partition(":")
        first, _, last = name.removeprefix("alpha_").partition("..")
        try:
            surfaces = tuple(int(number) for number in numbers.split("+")) if colon else None
            orders = range(int(first), int(last or first) + 1, 2) if name.startswith("alpha_") else ()
        except ValueError:
            raise InputError(f"--free {part}: expected variables such as curvature,thickness:1+3,alpha_4..10") from None
        names = [f"alpha_{order}" for order in orders] or [name]
        if repeated := free.keys() & set(names):
            raise InputError(f"--free: {min(repeated)} occurs twice; give its surfaces together, such as {name}:0+1")
        free |= dict.fromkeys(names, surfaces)
    return free
