"""Lens files, our YAML and Zemax's .zmx, with the specification that figures need."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Unpack

from tasklens.optics.io import lens_digest, prescription, zemax
from tasklens.optics.io.lens_specs import COMPUTED, LensFile, Requested, with_specification, without_figures
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.io.stop import check_radius
from tasklens.runtime.files import FileError
from tasklens.settings.messages import suggestion
from tasklens.settings.specification import Spec

_KEYS = (*prescription.KEYS, "spec", "origin", "digest", *COMPUTED)
_SPEC = (*Spec.model_fields, *Spec.model_computed_fields)
_SIMILAR = 0.8  # of a misspelled key


def read(
    path: Path, catalogues: Sequence[Path] = (), configuration: int | None = None, **requested: Unpack[Requested]
) -> LensFile:
    """Read a lens with its specification.

    A lens.yaml of ours contains the specification. For any other lens it is derived from the file.

    Args:
        path: a lens.yaml or a .zmx file.
        catalogues: glass catalogues (.agf, or our YAML) of a .zmx file.
        configuration: of a .zmx file with several; None: the one in which it was saved.
        requested: values that replace those of the file, as in `lens_specs.with_specification`.

    Raises:
        InputError: an object distance that is not positive.
        FileError: the file is not a lens or has no field, the object is in the lens, or a catalogue does not exist.
    """
    return with_specification(*read_prescription(path, catalogues, configuration), str(path), **requested)


def check_catalogues(catalogues: Sequence[Path]) -> None:
    """Raise FileError for a catalogue that does not exist."""
    for catalogue in catalogues:
        if not catalogue.is_file():
            raise FileError(f"{catalogue}: no such file or directory")


def read_prescription(
    path: Path, catalogues: Sequence[Path] = (), configuration: int | None = None
) -> tuple[Prescription, dict]:
    """Read the prescription of a lens from either kind of file, and the content of a YAML file; raises FileError."""
    check_catalogues(catalogues)
    suffix = path.suffix.lower()
    if suffix == ".zmx":
        return zemax.read(path, catalogues, configuration), {}
    if suffix in (".yaml", ".yml"):
        if configuration not in (None, 1):
            raise FileError(f"{path}: expected a configuration 1 .. 1, got {configuration} (--configuration)")
        source, content = prescription.read(path)
        _check_keys(content, path)
        check_radius(source, path)
        if lens_digest.is_changed(content):
            changed = "the lens was changed after its figures and margins were computed, so they are left out"
            return replace(source, remarks=(*source.remarks, changed)), without_figures(content)
        return source, content
    raise FileError(f"{path}: expected a lens file, .yaml or .zmx")


def write(path: Path, data: Prescription, notes: Mapping[str, Any]) -> None:
    """Write a lens as YAML with `notes`, or as a .zmx file for Zemax, which needs fields and wavelengths.

    Raises:
        FileError: another suffix, or a lens that the format does not support, such as one with decentres or a melt.
    """
    if data.lens.pose is not None or data.lens.melt is not None:
        raise FileError(f"{path}: lens files hold nominal lenses; remove `pose` and `melt`")
    if path.suffix.lower() in (".yaml", ".yml"):
        own = prescription.to_dict(data)
        prescription.write(path, data, {key: value for key, value in notes.items() if key not in own})
    elif path.suffix.lower() == ".zmx":
        zemax.write(path, data)
    else:
        raise FileError(f"{path}: expected .yaml, or .zmx for Zemax")


def _check_keys(content: Mapping[str, Any], path: Path) -> None:
    """Raise FileError for a key that is nearly one of a lens file, or unknown in its spec; other keys are notes."""
    for key in content:
        if key not in _KEYS and get_close_matches(str(key), _KEYS, 1, _SIMILAR):
            raise FileError(f"{path}: {key}: unknown key{suggestion(str(key), dict.fromkeys(_KEYS))}")
    spec = content.get("spec")
    for key in spec if isinstance(spec, Mapping) else ():
        if key not in _SPEC:
            raise FileError(f"{path}: spec.{key}: unknown key{suggestion(str(key), dict.fromkeys(_SPEC))}")
