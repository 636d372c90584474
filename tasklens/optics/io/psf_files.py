"""Files of the PSFs of a lens at sets of fields, with its relative illumination (safetensors)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tasklens.runtime.files import FileError, damage_error, read_tensors, write_tensors

_ROUNDING = 1e-4  # rounding of sums in float32
_TENSORS = ("psf", "illumination")


class FieldPsfs(NamedTuple):
    """PSFs (F, 3, K, K) and relative illumination (F,) of F fields, which images take in `turns` equal parts."""

    psf: Tensor
    illumination: Tensor
    turns: int


def write(
    path: Path, psf: Tensor, illumination: Tensor, sets: Mapping[str, tuple[int, int, int]], notes: Mapping[str, Any]
) -> None:
    """Write PSFs (F, 3, K, K) and relative illumination (F,) in float32.

    Args:
        sets: first field of each set, the one after its last, and the number of turns.
        notes: notes, which include `fields_mm`.
    """
    tensors = dict(zip(_TENSORS, (psf.float(), illumination.float()), strict=True))
    write_tensors(path, tensors, {**notes, "sets": {name: list(part) for name, part in sets.items()}})


def read(path: Path, fields: str) -> FieldPsfs:
    """Read the PSFs of a set of fields.

    Raises:
        FileError: there is no such set, a tensor is missing or has another shape, values are not finite or negative, or
            a PSF has an energy above 1.
    """
    tensors, notes = read_tensors(path)
    count, sets = len(notes.get("fields_mm", ())), notes.get("sets", {})
    if len(sets.get(fields, ())) != 3:  # files of earlier versions have two numbers, without turns
        raise FileError(f"{path}: has no PSFs of the fields of {fields}; remove it, and run its study again")
    psf, illumination = (tensors.get(name, torch.empty(0)) for name in _TENSORS)
    window = psf.shape[-1] if psf.dim() else 0
    if tuple(psf.shape) != (count, 3, window, window) or window % 2 == 0 or tuple(illumination.shape) != (count,):
        shapes = f"{tuple(psf.shape)} and {tuple(illumination.shape)}"
        raise damage_error(path, f"PSFs and illumination of {count} fields have the shapes {shapes}")
    energy = psf.sum((-2, -1))
    if not (torch.isfinite(energy).all() and psf.min() >= 0 and energy.max() <= 1 + _ROUNDING):
        raise damage_error(path, "PSFs that are negative, not finite or of more than all the light")
    if not (torch.isfinite(illumination).all() and illumination.min() >= 0):
        raise damage_error(path, "an illumination that is negative or not finite")
    first, end, turns = sets[fields]
    return FieldPsfs(psf[first:end], illumination[first:end], turns)
