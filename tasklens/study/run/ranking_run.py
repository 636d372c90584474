"""Ranking of lenses for a network: the study of the lenses, and its run."""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from tasklens.recognition import class_folders
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, read_table, write_text
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.network_settings import ClassifierSettings
from tasklens.study.run.digest import NOT_INSTALLED, SNAKEFILE
from tasklens.study.run.screening import ELEMENTS, Screened

_SHOWN = 200  # sharp photographs for the check of a network
_MINIVAL = 2  # photographs that a study needs in addition to the ranking's
_FOCUS, _LEAST_FOCUS = 24, 10  # photographs by which a network sets the focus, and the least number of them
_TESTED = 5  # one photograph in so many is tested if the network is trained on the others of the same folder


def study(
    name: str,
    screened: Screened,
    spec: Mapping[str, Any],
    images: Mapping[str, Any],
    classifier: Mapping[str, Any],
    capture: Mapping[str, Any],
    epochs: float,
    lenses: Sequence[str],
    tolerances: Mapping[str, Any],
    built: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the study that measures `lenses`, some of those that passed the screening.

    Raises:
        InputError: no lens can be measured.
    """
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
            "mtf": {f"{ELEMENTS}-{lens}": screened.mtf[lens] for lens in screened.by_mtf},
            "built": list(built),
        },
    }


def image_settings(folder: Path, size: int, photographs: int, trained: bool, focused: bool) -> dict[str, Any]:
    """Return the images of a ranking: at most `photographs` to test with; if `trained`, the others for training.

    Of a folder without splits, a fifth is tested if the network is trained; else a study needs a few others, and more
    if the network sets the focus of lenses (`focused`).

    Raises:
        FileError: the folder has no photographs by class, too few, or too few to set the focus.
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
    if focused and train < _LEAST_FOCUS:
        raise FileError(
            f"--images {folder}: has {train} photographs by which the network can set the focus; expected "
            f"{_LEAST_FOCUS} or more for training, or --focus mtf"
        )
    if test < 1:
        raise FileError(f"--images {folder}: too few photographs for a ranking; expected {least} or more")
    return images | {"test": test} | ({} if trained else {"train": train})


def photographs(images: Mapping[str, Any]) -> str:
    """Say how many photographs are ranked, of how many, and what the others are for."""
    folder, tested, train = Path(images["folder"]), images["test"], images.get("train")
    total = class_folders.count(class_folders.test_folder(folder), sys.maxsize)
    words = f"{tested} photographs" if tested == total else f"{tested} of {total} photographs"
    if class_folders.is_split(folder):
        limit = "" if tested == total else " (--max-images)"
        focus = f"; {train} of the training photographs set the focus" if train is not None and train > 1 else ""
        return f"{words}{limit}{focus}"
    if train is None:
        return f"{words}; the network is trained on others"
    most = " (--max-images)" if tested + train + _MINIVAL < total else ""
    purpose = "for the focus" if train > 1 else "needed as training images"
    return f"{words}{most}; {_MINIVAL + train} others are {purpose}"


def check_network(settings: ClassifierSettings, images: ImageSettings) -> str:
    """Describe how well a network recognises some of the sharp photographs, or that they are too few to tell.

    Raises:
        InputError: the network cannot be built or read, or recognises nothing.
    """
    from tasklens.recognition import classifiers, sharp
    from tasklens.recognition.dataset import test_images

    assert images.folder is not None
    classifiers.check("network", settings, images.size, len(class_folders.training_classes(images.folder)))
    examples = test_images(images.folder, images.size, _SHOWN)
    network = classifiers.build(settings, examples.classes)
    try:
        return sharp.check_accuracy(classifiers.frozen(network, examples.images), examples)
    except sharp.TooFewImages as error:
        return str(error)


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
