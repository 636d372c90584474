"""Design of one lens without a study."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from tasklens.design import methods
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.devices import claim
from tasklens.runtime.errors import InputError
from tasklens.study import single
from tasklens.study.study import Study
from tasklens.study.tables import candidates, lens_design, starts

_IMAGES = 2000  # of a folder, at most


def design(
    method: str = "least_squares",
    elements: Sequence[str] = ("COC", "OKP4"),
    *,
    seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    constraints: Mapping[str, Any] | None = None,
    materials: Sequence[str | Path] = (),
    images: str | Path | None = None,
    size: int = 224,
    classifier: Mapping[str, Any] | None = None,
    **spec: Any,
) -> tuple[Lens, View, dict[str, Any]]:
    """Design one lens; see `help(tasklens.design)`.

    Raises:
        InputError: a wrong value, an unknown plastic, images that cannot be read, weights that do not fit.
    """
    section = None if images is None else {"folder": str(images), "size": size, "train": _IMAGES, "minival": 2}
    files = [str(path) for path in materials]
    found = single.study(method, elements, spec, settings or {}, constraints or {}, files, section, classifier)
    for name, entry in found.lenses.items():
        if len(first := starts(found, name)) > 1:
            raise InputError(
                f"{entry.design_name} begins with one lens, got {', '.join(first)}; give it as `start` "
                f"(on the command line --set start=[{found.lens(first[0]).design_name}])"
            )
    view = view_of_spec(found.spec)
    made: dict[str, Lens] = {}
    notes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        dataset, network = _supervisors(found, Path(folder))
        for name in found.lenses:
            entry = found.lens(name)
            made[name], notes, _ = methods.design(
                lens_design(found, name, seed),
                network if entry.classified else None,
                dataset if entry.supervised else None,
                {other: (made[other], 0.0) for other in starts(found, name)},
                {other: made[other] for other in candidates(found, name)},
            )
    return made[name], view, notes


def _supervisors(study: Study, folder: Path) -> tuple[ImageDataset | None, nn.Module | None]:
    """Return the images and the network that designs of the study need; images are converted to a file in `folder`."""
    entries = study.lenses.values()
    if not any(entry.supervised for entry in entries):
        return None, None
    from tasklens.recognition import classifiers, dataset

    settings = study.classifier(study.supervisor)
    if any(entry.classified for entry in entries):
        classifiers.check(study.supervisor, settings, study.images.size)
    device = claim()
    images = dataset.training_images(study.images, folder / "images.npy", device=device)
    if not any(entry.classified for entry in entries):
        return images, None
    torch.manual_seed(0)
    return images, classifiers.build(settings, images.classes).to(device)
