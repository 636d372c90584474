"""Design of one lens without a study."""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tasklens.design import from_lens, methods, substitution
from tasklens.design.supervisors import supervisors
from tasklens.materials.library import users_files
from tasklens.optics.io import lens_files
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.study import single
from tasklens.study.tables import candidates, lens_design, starts

_IMAGES = 2000  # of a folder, at most
_BRIEF = 1000  # evaluations of least squares for each combination of materials


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
    start: str | Path | None = None,
    free: Mapping[str, Sequence[int] | None] | None = None,
    **spec: Any,
) -> tuple[Lens, View, dict[str, Any]]:
    """Design one lens; see `help(tasklens.design)`.

    Raises:
        InputError: a wrong value, an unknown plastic, images that cannot be read, weights that do not fit.
    """
    spots: dict[str, float] = {}
    section = None if images is None else {"folder": str(images), "size": size, "train": _IMAGES, "minival": 2}
    if start is not None:
        return _from_lens(Path(start), method, free, settings, constraints, materials, section, classifier, seed, spec)
    if any(substitution.ALTERNATIVE in element for element in elements):

        def spot(chosen: Sequence[str]) -> float:
            brief = {"constraints": constraints, "materials": materials, "seed": seed, **spec}
            notes = design("least_squares", chosen, settings={"evaluations": _BRIEF}, **brief)[2]
            return float(sum(notes["figures"]["rms_centroid_um"]) / len(notes["figures"]["rms_centroid_um"]))

        elements, spots = substitution.sharpest(elements, spot)
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
        dataset, network = supervisors(found, Path(folder))
        for name in found.lenses:
            entry = found.lens(name)
            made[name], notes, _ = methods.design(
                lens_design(found, name, seed),
                network if entry.classified else None,
                dataset if entry.supervised else None,
                {other: (made[other], 0.0) for other in starts(found, name)},
                {other: made[other] for other in candidates(found, name)},
            )
    if spots:
        notes["origin"]["materials_tried_rms_um"] = spots
    return made[name], view, notes


def _from_lens(
    start: Path,
    method: str,
    free: Mapping[str, Sequence[int] | None] | None,
    settings: Mapping[str, Any] | None,
    constraints: Mapping[str, Any] | None,
    catalogues: Sequence[str | Path],
    images: Mapping[str, Any] | None,
    classifier: Mapping[str, Any] | None,
    seed: int,
    spec: Mapping[str, Any],
) -> tuple[Lens, View, dict[str, Any]]:
    """Improve the lens of a file."""
    file = lens_files.read(start, [*(Path(path) for path in catalogues), *users_files()], **spec)
    lens, view, notes, remarks = from_lens.design(
        file, method, free, settings or {}, constraints or {}, images, classifier, seed
    )
    for remark in (*file.remarks, *remarks):
        print(f"tasklens: {start}: {remark}", file=sys.stderr)
    notes["origin"] |= {"start": str(start)}
    return lens, view, notes
