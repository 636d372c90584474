"""`tasklens rank`: rank lenses for a network."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer

from tasklens.cli.options import Catalogues, NetworkOptions, PhotographOptions, with_options
from tasklens.cli.outputs import progress_bars, say
from tasklens.runtime.errors import InputError
from tasklens.settings.names import Focus

_SENSOR, _MORE = "Sensor and object", "Further options"


@dataclass(frozen=True)
class SensorOptions:
    """The sensor of all lenses, and the object."""

    panel: ClassVar[str] = _SENSOR
    diagonal: Annotated[float, typer.Option(help="Diagonal of the sensor (mm).")] = 4.0
    pixel_pitch: Annotated[float, typer.Option(help="Pixel pitch (um).")] = 1.8
    kernel_size: Annotated[int, typer.Option(help="Width of the PSF window (pixels, odd).")] = 51
    wavelengths: Annotated[
        str | None, typer.Option(help="Wavelengths (um) of all lenses; by default 0.6563,0.5893,0.4861.")
    ] = None
    object_distance: Annotated[float, typer.Option(help="Distance of the object (mm), or inf.")] = math.inf
    full_well: Annotated[float | None, typer.Option(min=1, help="Add sensor noise: electrons per pixel at white.")] = (
        None
    )
    diffraction: Annotated[
        bool, typer.Option("--diffraction", help="Include diffraction in the PSFs.", rich_help_panel=_MORE)
    ] = False

    def spec(self) -> dict[str, Any]:
        """Return the section `spec` of a study."""
        colours = {} if self.wavelengths is None else {"wavelengths_um": self.wavelengths.split(",")}
        return {
            "diagonal_mm": self.diagonal,
            "pixel_pitch_um": self.pixel_pitch,
            "kernel_size": self.kernel_size,
            "object_distance_mm": None if self.object_distance == math.inf else self.object_distance,
        } | colours

    def capture(self) -> dict[str, Any]:
        """Return the section `capture` of a study."""
        sensor = None if self.full_well is None else {"full_well": self.full_well}
        return {"diffraction": self.diffraction, "sensor": sensor}


@dataclass(frozen=True)
class LensOptions:
    """Reading of lenses, and the choice of those that are measured."""

    panel: ClassVar[str] = _SENSOR
    scale: Annotated[
        bool, typer.Option("--scale", help="Scale lenses to the sensor; for patents, not for products.")
    ] = False
    focus: Annotated[
        Focus | None,
        typer.Option(
            help="Image plane: as in the file, least loss of the network, peak of the MTF, smallest spot; by default "
            "as in the file, and by the network if the lens is scaled or the object at another distance."
        ),
    ] = None
    sieve: Annotated[
        int | None,
        typer.Option(min=3, help="Measure only this many lenses, those with the highest MTF.", rich_help_panel=_MORE),
    ] = None
    catalogue: Catalogues = None


@with_options(photographs=PhotographOptions, network=NetworkOptions, sensor=SensorOptions, lens_options=LensOptions)
def rank(
    lenses: Annotated[
        list[Path], typer.Argument(help="Lens files, .zmx or .yaml, or folders of them.", show_default=False)
    ],
    *,
    photographs: PhotographOptions,
    network: NetworkOptions,
    max_images: Annotated[int, typer.Option(min=10, help="Maximum number of photographs.")] = 500,
    sensor: SensorOptions,
    lens_options: LensOptions,
    fine_tune: Annotated[
        float, typer.Option(min=0, help="Epochs of fine-tuning on each lens.", rich_help_panel=_MORE)
    ] = 0.0,
    as_built: Annotated[
        int, typer.Option(min=0, help="Monte Carlo tolerancing of this many of the best lenses.", rich_help_panel=_MORE)
    ] = 0,
    grade: Annotated[
        str | None,
        typer.Option(help="Tolerance grade of built lenses; by default precision_moulding.", rich_help_panel=_MORE),
    ] = None,
    name: Annotated[str, typer.Option(help="Name; results are in results/NAME.")] = "ranking",
    cores: Annotated[int, typer.Option("--cores", "-j", min=1, help="Number of jobs at once.")] = 2,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite results with other options.")] = False,
) -> None:
    """Rank lenses by the accuracy of a network behind them: a table and a page. An interrupted ranking resumes.

    tasklens rank catalogue/ --images photographs --network resnet18 --weights mine.safetensors --diagonal 6
    """
    if (folder := photographs.images) is None or network.network is None:
        raise InputError("expected --images FOLDER and --network NAME with --weights FILE (or --pretrained)")
    if as_built and sensor.diffraction:
        raise InputError("--as-built: not with --diffraction; omit one of them")
    if grade is not None and not as_built:
        raise InputError("--grade: only with --as-built COUNT")
    classifier = network.settings()
    assert classifier is not None  # it has a name
    from tasklens.materials.library import user_files
    from tasklens.recognition.dataset import PHOTOGRAPH_SIZE
    from tasklens.study import loading
    from tasklens.study.run import ranking_run, screening

    spec = sensor.spec()
    paths = screening.lens_paths(lenses)
    side = PHOTOGRAPH_SIZE if photographs.size is None else photographs.size
    tolerances = {} if grade is None else {"grade": grade}

    def study(screened: screening.Screened, built: Sequence[str] = ()) -> dict:
        kept = screened.by_mtf[: lens_options.sieve]
        focused = any(screened.entries[lens]["focus"] == "network" for lens in kept)
        images = ranking_run.image_settings(folder, side, max_images, fine_tune > 0, focused)
        sections = spec, images, classifier, sensor.capture()
        return ranking_run.study(name, screened, *sections, fine_tune, kept, tolerances, built)

    unread = loading.parse(study(screening.placeholder()))  # errors come before the lenses are read
    say(ranking_run.check_network(unread.classifier(unread.supervisor), unread.images))
    with progress_bars():
        catalogues = [*(lens_options.catalogue or ()), *user_files()]
        screened = screening.screen(paths, spec, catalogues, lens_options.scale, lens_options.focus)
    content = study(screened)
    count = len(loading.parse(content).imported)
    say(f"{count} of {len(paths)} lenses are measured with {ranking_run.photographs(content['images'])}")
    results = ranking_run.run(content, ["ranking"], cores, overwrite)
    if as_built:
        content = study(screened, ranking_run.first_lenses(results, content["ranking"]["titles"], as_built))
        results = ranking_run.run(content, ["ranking"], cores, overwrite)
    print((results / "tables" / "ranking.md").read_text(encoding="utf-8"))
    say(f"the page: {results / 'ranking.html'}")
