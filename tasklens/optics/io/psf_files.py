"""Files of the PSFs of a lens at all fields, with its relative illumination (safetensors)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tasklens.runtime.files import damaged, read_tensors, write_tensors

_ROUNDING = 1e-4  # rounding of sums in float32


class FieldPsfs(NamedTuple):
    """PSFs (F, 3, K, K) and relative illumination (F,) of F fields."""

    psf: Tensor
    illumination: Tensor


def write(path: Path, psfs: FieldPsfs, notes: Mapping[str, Any]) -> None:
    """Write PSFs in float32 with `notes`, which include their `fields_mm`."""
    write_tensors(path, {name: tensor.float() for name, tensor in psfs._asdict().items()}, notes)


def read(path: Path) -> FieldPsfs:
    """Read PSFs.

    Raises:
        FileError: a tensor is missing or has another shape, values are not finite or negative, or a PSF has an energy
            above 1.
    """
    tensors, notes = read_tensors(path)
    fields = len(notes.get("fields_mm", ()))
    psf, illumination = (tensors.get(name, torch.empty(0)) for name in FieldPsfs._fields)
    window = psf.shape[-1] if psf.dim() else 0
    if tuple(psf.shape) != (fields, 3, window, window) or window % 2 == 0 or tuple(illumination.shape) != (fields,):
        shapes = f"{tuple(psf.shape)} and {tuple(illumination.shape)}"
        raise damaged(path, f"PSFs and illumination of {fields} fields have the shapes {shapes}")
    energy = psf.sum((-2, -1))
    if not (torch.isfinite(energy).all() and psf.min() >= 0 and energy.max() <= 1 + _ROUNDING):
        raise damaged(path, "PSFs that are negative, not finite or of more than all the light")
    if not (torch.isfinite(illumination).all() and illumination.min() >= 0):
        raise damaged(path, "an illumination that is negative or not finite")
    return FieldPsfs(psf, illumination)
