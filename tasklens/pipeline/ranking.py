"""Ranking of lenses for a network: from lens files to a study of imported lenses, and its run."""

import math
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from pydantic import ValidationError

from tasklens.optics.analysis.focus import refocused
from tasklens.optics.analysis.mtf import mean_mtf
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.analysis.spots import evaluation_psf, has_light
from tasklens.optics.io import imported, lens_files
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import view_of_spec
from tasklens.pipeline.digest import NOT_INSTALLED, SNAKEFILE
from tasklens.recognition import class_folders
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, read_table, write_text
from tasklens.runtime.progress import Progress
from tasklens.study.lens_entries import Focus, ImportedLens
from tasklens.study.messages import problems
from tasklens.study.settings import ClassifierSettings, ImageSettings, Spec

ELEMENTS = "lens"  # name of the elements of all lenses in the study
_SUFFIXES = (".zmx", ".yaml", ".yml")
_SHIPPED = "config/lenses/phone_3p.yaml"
_RAYS = 4096  # per field and colour
_ROUNDS = 20  # of the fixed point for the scale of a lens with a near object; each gains a digit or more
_COVERAGE = 0.99  # least part of the sensor's half diagonal that the field in a lens file covers
_LONGEST = 30  # characters of a name
_SHOWN = 200  # sharp photographs for the check of a network
_MINIVAL = 2  # photographs that a study needs in addition to the ranking's
_FOCUS = 24  # photographs by which a network sets the focus
_TESTED = 5  # one photograph in so many is tested if the network is trained on the others of the same folder


@dataclass
class Screened:
    """Results of screening lens files: usable lenses by name, and the reasons against the others.

    Attributes:
        entries: the lenses as a study imports them.
        titles: names of their files, by name.
        mtf: mean MTF, by name.
        left_out: reasons why a file cannot be measured, by its name.
    """

    entries: dict[str, dict[str, Any]] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)
    mtf: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def lens_paths(places: Sequence[Path]) -> list[Path]:
    """Return lens files, also from inside folders; raises FileError if a path does not exist."""
    files: list[Path] = []
    for path in places:
        if path.is_dir():
            inside = (file for file in sorted(path.rglob("*")) if file.suffix.lower() in _SUFFIXES)
            files += [file for file in inside if not file.name.startswith(".")]
        elif path.is_file():
            files.append(path)
        else:
            raise FileError(f"{path}: no such lens file or folder")
    if not files:
        raise FileError(f"{', '.join(map(str, places))}: no lens file there, expected {', '.join(_SUFFIXES)}")
    return list(dict.fromkeys(files))


def unread() -> Screened:
    """Return a published lens in place of those to be read, to check a study before they are."""
    return Screened(
        {ELEMENTS: {"elements": ELEMENTS, "file": _SHIPPED, "focus": "file"}}, {ELEMENTS: ELEMENTS}, {ELEMENTS: 0.0}
    )


def screen(
    paths: Sequence[Path],
    spec: Mapping[str, Any],
    catalogues: Sequence[Path],
    scaled: bool,
    focus: Focus | None = None,
) -> Screened:
    """Read lenses, and check which of them can be used with a sensor.

    Args:
        spec: keys of `Spec`: the sensor and the distance of the object.
        catalogues: additional glass catalogues.
        scaled: scale lenses so that their field fills the sensor; otherwise they keep their size.
        focus: what sets their image planes; None: as in `ImportedLens`.

    Raises:
        InputError: a value of the sensor is invalid, or a catalogue does not exist.
    """
    lens_files.check_catalogues(catalogues)
    try:
        sensor = Spec.model_validate(dict(spec))
    except ValidationError as error:
        raise InputError("; ".join(problems(error, Spec))) from None
    screened = Screened()
    progress = Progress("reading lenses", len(paths))
    for step, path in enumerate(paths, 1):
        title = _title(path, paths)
        try:
            entry, mtf, remarks = _screened(path, sensor, catalogues, scaled, focus)
        except ValidationError as error:
            screened.left_out[title] = "; ".join(problems(error, Spec))
        except (InputError, OSError) as error:
            screened.left_out[title] = str(error).removeprefix(f"{path}: ")
        else:
            name = _name(path, screened.entries)
            screened.entries[name], screened.titles[name], screened.mtf[name] = entry, title, mtf
            for remark in remarks:
                print(f"tasklens: {path}: {remark}", file=sys.stderr)
        progress(step)
    return screened


def _screened(
    path: Path, sensor: Spec, catalogues: Sequence[Path], scaled: bool, focus: Focus | None
) -> tuple[dict[str, Any], float, Sequence[str]]:
    """Return the entry of a lens in a study, its mean MTF, and assumptions about its file; raises InputError."""
    file = lens_files.read(path, catalogues)
    check_focal_length(file.lens, sensor.wavelengths_um[1], "a ranking needs")
    efl, f_number = imported.size(file.lens, file.content.get("spec", {}), sensor.wavelengths_um[1])
    tangent, half = float(file.view.radii.max()) / file.view.efl, sensor.diagonal_mm / 2
    if not tangent:
        raise InputError("its file has no field except the axis")
    remarks = [*file.prescription.remarks]
    if _differ(file.view.wavelengths_um, sensor.wavelengths_um):
        own, others = (
            ", ".join(f"{value:g}" for value in v) for v in (file.view.wavelengths_um, sensor.wavelengths_um)
        )
        remarks.append(f"is designed for {own} um, and ranked at {others} um (--wavelengths)")
    growth = _image_scale(file.lens, sensor)
    if scaled:
        for _ in range(_ROUNDS):
            growth = _image_scale(file.lens.scaled(half / (growth * tangent * efl)), sensor)
    else:
        radius = growth * efl * tangent
        if radius < _COVERAGE * half:
            raise InputError(
                f"covers {2 * radius:.2f} mm of the sensor's diagonal of {sensor.diagonal_mm:g} mm (--scale makes it "
                "fit)"
            )
        if radius * _COVERAGE > half:
            remarks.append(f"has a field of {2 * radius:.2f} mm, used up to the sensor's diagonal of {2 * half:g} mm")
        tangent = half / (growth * efl)
    lens_spec = {
        "diagonal_mm": 2 * half / growth,  # of the image of an object at infinity, as in all specifications
        "field_of_view_deg": math.degrees(2 * math.atan(tangent)),
        "f_number": f_number,
    }
    files = {"file": str(path), "catalogues": [*map(str, catalogues)]}
    entry = {"elements": ELEMENTS, **files, "spec": lens_spec}
    spec = Spec.model_validate(sensor.model_dump(exclude_computed_fields=True) | lens_spec)
    view = view_of_spec(spec)
    lens, details = imported.fit(ImportedLens.model_validate(entry), view, spec.f_number)
    if not (light := has_light(lens, view)).all():
        raise InputError(f"no light arrives at {int((~light).sum())} of {len(light)} fields")
    by = focus or imported.focus(details)
    if by != "file":
        lens = refocused(lens, view, "spot" if by == "spot" else "mtf")
    grid = evaluation_psf(lens, view, _RAYS)
    remarks += filter(None, [window_remark(energy_inside(grid), view.kernel_size)])
    return entry | {"focus": by}, float(mean_mtf(grid)), remarks


def _image_scale(lens: Lens, sensor: Spec) -> float:
    """Return the ratio of the image height to that for an object at infinity; raises InputError."""
    return float(image_scale(lens, view_of_spec(sensor)))


def _differ(wavelengths: Sequence[float], others: Sequence[float]) -> bool:
    """Return whether the ends of two ranges of wavelengths differ by more than a tenth."""
    ends = ((min(wavelengths), min(others)), (max(wavelengths), max(others)))
    return any(abs(a - b) > 0.1 * b for a, b in ends)


def _title(path: Path, paths: Sequence[Path]) -> str:
    """Return the name of a file, with its folder if another file has the same name."""
    namesakes = [other for other in paths if other.stem == path.stem]
    return path.stem if len(namesakes) == 1 else str(path)


def _name(path: Path, existing: Iterable[str]) -> str:
    """Return a name for a lens that the study does not use yet."""
    base = re.sub("[^a-z0-9]+", "_", path.stem.lower()).strip("_")[:_LONGEST] or "lens"
    names = [base, *(f"{base}_{k}" for k in range(2, 10_000))]
    return next(name for name in names if name not in set(existing))


def study(
    name: str,
    screened: Screened,
    spec: Mapping[str, Any],
    images: Mapping[str, Any],
    classifier: Mapping[str, Any],
    capture: Mapping[str, Any],
    epochs: float,
    keep: int | None,
    tolerances: Mapping[str, Any],
    built: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the study that measures lenses; `keep` limits it to the lenses with the highest MTF.

    Raises:
        InputError: no lens can be measured.
    """
    order = sorted(screened.entries, key=lambda lens: -screened.mtf[lens])
    lenses = order if keep is None else order[:keep]
    if not lenses:
        reasons = "; ".join(f"{title}: {why}" for title, why in screened.left_out.items())
        raise InputError(f"none of the lenses can be measured: {reasons}")
    return {
        "format": 3,
        "name": name,
        "tables": ["table1"],
        "images": dict(images),
        "spec": dict(spec),
        "capture": dict(capture),
        "fields": {"nine": True},
        "elements": {},
        "designs": {},
        "imported": {lens: screened.entries[lens] for lens in lenses},
        "supervisor": "network",
        "classifiers": {"network": dict(classifier)},
        "fine_tuning": {"epochs": epochs, "learning_rate": 1e-4, "batch_size": 16},
        "restoration": {"steps": 1, "encoder": [1], "decoder": [1]},
        "tolerances": dict(tolerances),
        "ranking": {
            "titles": {f"{ELEMENTS}-{lens}": screened.titles[lens] for lens in lenses},
            "left_out": screened.left_out,
            "mtf": {f"{ELEMENTS}-{lens}": screened.mtf[lens] for lens in order},
            "built": list(built),
        },
    }


def image_settings(folder: Path, size: int, photographs: int, trained: bool, focused: bool) -> dict[str, Any]:
    """Return the images of a ranking: at most `photographs` to test with; if `trained`, the others for training.

    Of a folder without splits, a fifth is tested if the network is trained; else a study needs a few others, and more
    if the network sets the focus of lenses (`focused`).

    Raises:
        FileError: the folder has no photographs by class, or too few.
    """
    if not folder.is_dir():
        raise FileError(f"--images {folder}: no such folder")
    images = {"folder": str(folder), "size": size, "minival": _MINIVAL}
    train = _FOCUS if focused else 1
    if class_folders.is_split(folder):
        test, least = class_folders.count(class_folders.test_folder(folder), photographs), 1
        train = max(1, min(train, class_folders.count(class_folders.train_folder(folder), train + _MINIVAL) - _MINIVAL))
    elif trained:
        test, least = class_folders.count(folder, _TESTED * photographs) // _TESTED, _TESTED
    else:
        others = _MINIVAL + train
        test, least = class_folders.count(folder, photographs + others) - others, others + 1
    if test < 1:
        raise FileError(f"--images {folder}: too few photographs for a ranking; expected {least} or more")
    return images | {"test": test} | ({} if trained else {"train": train})


def photographs(images: Mapping[str, Any]) -> str:
    """Say how many photographs are ranked, of how many, and what the others are for."""
    folder, tested, train = Path(images["folder"]), images["test"], images.get("train")
    total = class_folders.count(class_folders.test_folder(folder), sys.maxsize)
    if tested == total:
        return f"{tested} photographs"
    words = f"{tested} of {total} photographs"
    if class_folders.is_split(folder):
        return f"{words} (--max-images)"
    if train is None:
        return f"{words}; the network is trained on others"
    most = " (--max-images)" if tested + train + _MINIVAL < total else ""
    purpose = "for the focus" if train > 1 else "needed as training images"
    return f"{words}{most}; {_MINIVAL + train} others are {purpose}"


def check_network(settings: ClassifierSettings, images: ImageSettings) -> str:
    """Describe how well a network recognises some of the sharp photographs.

    Raises:
        InputError: the network cannot be built or read, or recognises nothing.
    """
    from tasklens.recognition import classifiers, sharp, user_images

    assert images.folder is not None
    classifiers.check("network", settings, images.size, len(class_folders.training_classes(images.folder)))
    photographs = user_images.test_images(images.folder, images.size, _SHOWN)
    network = classifiers.build(settings, photographs.classes)
    return sharp.check_accuracy(classifiers.frozen(network, photographs.images), photographs)


def run(content: Mapping[str, Any], targets: Sequence[str], cores: int, overwrite: bool) -> Path:
    """Run the study by Snakemake; return the folder of its results.

    Raises:
        SystemExit: Snakemake fails; it has printed the reason.
        InputError: the workflow is not installed.
    """
    if not SNAKEFILE.is_file():
        raise InputError(f"{SNAKEFILE}: {NOT_INSTALLED}")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), "--cores", str(cores), *targets]
    with TemporaryDirectory() as folder:  # the run writes study.yaml, unless it is refused
        path = Path(folder, "ranking.yaml")
        write_text(path, yaml.safe_dump(dict(content), sort_keys=False))
        command += ["--configfile", str(path), *(["--config", "overwrite=true"] if overwrite else [])]
        status = subprocess.run(command).returncode
    if status:
        raise SystemExit(status)
    return Path("results", str(content["name"]))


def first_lenses(folder: Path, titles: Mapping[str, str], count: int) -> list[str]:
    """Return the first lenses of a finished ranking by their names in the study."""
    names = {title: lens for lens, title in titles.items()}
    table = read_table(folder / "tables" / "ranking.csv")
    return [names[str(title)] for title in table["lens"][:count]]
