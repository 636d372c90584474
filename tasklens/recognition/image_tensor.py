"""Conversion of a user's image, a file or any common array type, to a tensor."""

from pathlib import Path

import numpy
import torch
from PIL.Image import Image as PillowImage
from torch import Tensor

from tasklens.recognition.folders import read_whole, rgb
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.runtime.tensors import NO_VALUES, as_tensor

Image = str | Path | PillowImage | numpy.ndarray | Tensor
_ROUNDING = 1e-6  # tolerance of floats in [0, 1]


def image_tensor(image: Image) -> Tensor:
    """Return an image as a tensor (3, H, W) in [0, 1]; raises InputError."""
    if isinstance(image, str | Path):
        if not Path(image).is_file():
            raise FileError(f"{image}: no such image")
        return read_whole(Path(image)).float() / 255
    if not isinstance(image, Tensor):
        if hasattr(image, "read"):
            raise InputError(
                "image: expected the path of a file, a Pillow image, an array or a tensor, got an open file, "
                f"{type(image).__name__}; give PIL.Image.open(file)"
            )
        try:
            array = numpy.array(rgb(image) if isinstance(image, PillowImage) else image)
        except ValueError as error:
            raise InputError(f"image: {error}") from None
        if array.dtype.kind == "u" and array.dtype.itemsize == 2:
            array = array / 65535
        tensor = as_tensor(array, "image")
        image = tensor.movedim(-1, 0) if tensor.dim() == 3 else tensor
    if image.is_meta:
        raise InputError(f"image: {NO_VALUES}")
    if image.dim() != 3 or image.shape[0] != 3:
        hint = "; repeat a grey one three times" if image.dim() == 2 or 1 in image.shape[:1] else ""
        raise InputError(f"image: expected an array (H, W, 3) or a tensor (3, H, W), got {tuple(image.shape)}{hint}")
    if image.dtype in (torch.uint8, torch.uint16):
        return image.float() / torch.iinfo(image.dtype).max
    if not image.is_floating_point():
        raise InputError(f"image: expected uint8, uint16 or floats in [0, 1], got {image.dtype}")
    low, high = float(image.detach().min()), float(image.detach().max())
    if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
        advice = "scale them, or convert to uint8" if low >= 0 else "normalise in the network, not before the lens"
        raise InputError(f"image: expected floats in [0, 1], got {low:g} to {high:g}; {advice}")
    return image.float()
