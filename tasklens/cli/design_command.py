"""`tasklens design`: one lens without a study."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from tasklens.cli.options import PANEL, NetworkOptions, PhotographOptions, Seed, parse_settings, with_options
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

if TYPE_CHECKING:
    from tasklens.design.chain import Designs
    from tasklens.design.single import Specification
    from tasklens.recognition.dataset import ImageDataset

_SPEC = "Specification (with --start: overrides of the file)"
_METHOD = (
    "Design method: least_squares (the default), spot (the default with --start), contrast, "
    "log_image_error, correlation; with a network: task, joint, end_to_end."
)
_START = "Start from a lens file"
_VERDICT = "Verdict"


@dataclass(frozen=True)
class MethodOptions:
    """A design method, and the settings that differ from its own."""

    method: Annotated[str | None, typer.Option(help=_METHOD, show_default=False)] = None
    seed: Seed = 0
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Setting of the method, as in a study: evaluations=2000, descents.0.steps=200."),
    ] = None
    limits: Annotated[
        list[str] | None, typer.Option("--limit", help="Limit, a key of `constraints` in a study: max_track=6.")
    ] = None


@dataclass(frozen=True)
class StartOptions:
    """The start of a design, and what of it is free."""

    panel: ClassVar[str] = _START
    start: Annotated[
        Path | None,
        typer.Option(
            help="Lens to improve, .zmx or .yaml; its glasses stay. flat: plane-parallel plates, as in the paper, with "
            "the schedule of the studies (task, log_image_error, correlation): not more accurate than from imaging "
            "lenses, the default, in up to five times as many steps."
        ),
    ] = None
    free: Annotated[
        str | None,
        typer.Option(help="Free variables and surfaces, numbered from 0: curvature,thickness:1+3,alpha_4..10."),
    ] = None
    configuration: Annotated[int | None, typer.Option(help="Configuration number, if the .zmx file has several.")] = (
        None
    )
    object_distance: Annotated[float | None, typer.Option(help="Only inf: move the file's object to infinity.")] = None

    @property
    def is_flat(self) -> bool:
        """True if the start is plane-parallel plates."""
        return self.start == Path("flat")

    @property
    def file(self) -> Path | None:
        """The file of a lens."""
        return None if self.is_flat else self.start

    def check(self) -> None:
        """Raise InputError for options that belong to a file."""
        if self.file is None and (self.free, self.configuration, self.object_distance) != (None, None, None):
            raise InputError("--free, --configuration, --object-distance: only with --start FILE")


@dataclass(frozen=True)
class SpecOptions:
    """Specification of the lens."""

    panel: ClassVar[str] = _SPEC
    f_number: Annotated[float | None, typer.Option(help="F-number; by default 2.8.")] = None
    field_of_view: Annotated[float | None, typer.Option(help="Full field of view (degrees); by default 68.8.")] = None
    diagonal: Annotated[float | None, typer.Option(help="Diagonal of the sensor (mm); by default 4.")] = None
    pixel_pitch: Annotated[float | None, typer.Option(help="Pixel pitch (um); by default 1.8.")] = None
    kernel_size: Annotated[int | None, typer.Option(help="Width of the PSF window (pixels); by default 51.")] = None
    wavelengths: Annotated[str | None, typer.Option(help="Wavelengths (um); by default 0.6563,0.5893,0.4861.")] = None

    def values(self) -> "Specification":
        """Return the values by their keys in a study; None for a default."""
        return {
            "f_number": self.f_number,
            "field_of_view_deg": self.field_of_view,
            "diagonal_mm": self.diagonal,
            "pixel_pitch_um": self.pixel_pitch,
            "kernel_size": self.kernel_size,
            "wavelengths_um": self.wavelengths and self.wavelengths.split(","),
        }


@with_options(
    method=MethodOptions, start=StartOptions, spec=SpecOptions, photographs=PhotographOptions, network=NetworkOptions
)
def design(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File of the lens, .yaml or .zmx.", show_default=False)
    ],
    elements: Annotated[str | None, typer.Option(help="Materials from front to back, by default COC,OKP4.")] = None,
    *,
    method: MethodOptions,
    catalogue: Annotated[
        list[Path] | None, typer.Option(help="File of further glasses (.agf) or plastics (.yaml).")
    ] = None,
    start: StartOptions,
    spec: SpecOptions,
    photographs: PhotographOptions,
    network: NetworkOptions,
    save_network: Annotated[
        Path | None,
        typer.Option(help="File for the network that joint or end_to_end trains, .safetensors.", rich_help_panel=PANEL),
    ] = None,
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
    new_file(output, force, ".yaml", ".yml", ".zmx")
    if output.suffix.lower() == ".zmx":
        new_catalogue(output, force)
    if start.file is not None and (elements, spec.diagonal) != (None, None):
        raise InputError("--elements, --diagonal: not allowed with --start, since its lens has them")
    start.check()
    classifier = _network(method.method, network, save_network, force)
    from tasklens.design import single
    from tasklens.design.single import LensRequest
    from tasklens.recognition.dataset import unused_images
    from tasklens.show import glance

    request = LensRequest(
        method=method.method,
        elements=elements and elements.split(","),
        seed=method.seed,
        settings=parse_settings(method.settings or (), "--set"),
        constraints=parse_settings(method.limits or (), "--limit"),
        catalogues=catalogue or (),
        images=photographs.images,
        size=photographs.size,
        network=classifier,
        start="flat" if start.is_flat else start.file,
        free=None if start.free is None else _free(start.free),
        spec={**spec.values(), "configuration": start.configuration, "object_distance_mm": start.object_distance},
    )
    unused, page = None, output.with_suffix(".html")
    if verdict and method.method == "task" and photographs.images is not None and classifier is not None:
        new_file(page, force, ".html")
        unused = unused_images(photographs.images, photographs.size)
    with progress_bars(), _keys_as_options():
        baselines = () if unused is None else single.BASELINES
        result = single.designs(request, True, baselines, lambda text: say(f"{start.file}: {text}"))
    summary = _write(output, result, save_network, improved=start.file is not None)
    if unused is not None:
        summary |= _compare(output, page, result, unused)
    if json:
        print_json(summary)
        return
    print(glance.text(str(output), summary))
    if unused is not None:
        print(f"\n{summary['verdict']}\nThe page: {page}")


def _network(
    method: str | None, network: NetworkOptions, save_network: Path | None, force: bool
) -> dict[str, Any] | None:
    """Return the settings of the network; raises InputError if its file is missing, or has no use."""
    from tasklens.settings.lens_settings import TRAINING

    if save_network is not None:
        new_file(save_network, force, ".safetensors")
        if method not in TRAINING:
            raise InputError("--save-network: only with --method joint or end_to_end, which train the network")
    settings = network.settings()
    if settings is not None and method in TRAINING and save_network is None:
        raise InputError(f"--method {method}: trains the network with the lens; give --save-network FILE for it")
    return settings


def _write(output: Path, result: "Designs", save_network: Path | None, improved: bool) -> dict[str, Any]:
    """Write the lens, its catalogue and the trained network; return a summary; raises InputError for a dark lens."""
    from tasklens.optics.io import lens_files
    from tasklens.runtime.files import write_tensors
    from tasklens.show import glance

    notes = result.notes
    dark = sum(not math.isfinite(radius) for radius in notes["figures"]["rms_centroid_um"])
    if dark:
        hint = "take fewer steps, or smaller ones" if improved else "try another --seed"
        raise InputError(f"no light arrives at {dark} of the design's fields; nothing is written: {hint}")
    if save_network is not None:
        assert result.trained_weights is not None  # by these methods
        write_tensors(save_network, result.trained_weights, {"lens": str(output)})
        say(f"wrote {save_network}")
    if result.remark:
        say(f"{output}: {result.remark}")
    lens_files.write(output, result.prescription, notes)
    say_catalogue(output, result.lens.media)
    return glance.summary(result.lens, notes, notes["figures"]) | {"file": str(output)}


def _compare(output: Path, page: Path, result: "Designs", unused: "ImageDataset") -> dict[str, str]:
    """Compare the lens with those for image quality on photographs that no design has used; write the page."""
    from tasklens.api.design import verdict

    with progress_bars(), remarks_about(output):
        answer, ranking = verdict(result, unused)
    ranking.save(page, "Lens comparison", [answer])
    return {"verdict": answer, "page": str(page)}


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
