"""One image: a file, a Pillow image, an array or a tensor, as a tensor of RGB values."""

from pathlib import Path

import numpy
import torch
from PIL import Image as pillow
from PIL import ImageOps
from torch import Tensor

from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.runtime.tensors import NO_VALUES, as_tensor

pillow.MAX_IMAGE_PIXELS = 250_000_000  # Pillow rejects twice this number (1.5 GB): a small file can claim any size
Image = str | Path | pillow.Image | numpy.ndarray | Tensor
_ROUNDING = 1e-6  # tolerance of floats in [0, 1]


def image_tensor(image: Image) -> Tensor:
    """Return an image as a tensor (3, H, W) in [0, 1]; raises InputError."""
    if isinstance(image, str | Path):
        if not Path(image).is_file():
            raise FileError(f"{image}: no such image")
        return _tensor(decode(Path(image))).float() / 255
    if not isinstance(image, Tensor):
        if hasattr(image, "read"):
            raise InputError(
                "image: expected the path of a file, a Pillow image, an array or a tensor, got an open file, "
                f"{type(image).__name__}; give PIL.Image.open(file)"
            )
        try:
            array = numpy.array(rgb(image) if isinstance(image, pillow.Image) else image)
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


def read(path: Path, size: int) -> Tensor:
    """Read the central square of an image as RGB, resized to (3, size, size) uint8; raises FileError."""
    return _tensor(ImageOps.fit(decode(path), (size, size), pillow.Resampling.BICUBIC))


def decode(path: Path) -> pillow.Image:
    """Decode an image to RGB, rotated by its EXIF tag; raises FileError."""
    try:
        with pillow.open(path) as file:
            return rgb(ImageOps.exif_transpose(file))
    except Exception as error:  # any type, depending on the decoder
        raise FileError(f"{path}: cannot be read as an image ({error})") from error


def rgb(image: pillow.Image) -> pillow.Image:
    """Convert an image to 8-bit RGB; raises ValueError for floating-point values outside [0, 1]."""
    if image.mode == "F":
        image = _of_floats(image)
    elif image.mode.startswith("I"):  # 16-bit grey, which `convert` would clip at 255
        image = image.convert("I").point(lambda value: value * (1 / 256)).convert("L")
    return image.convert("RGB")


def _of_floats(image: pillow.Image) -> pillow.Image:
    """Convert a floating-point image in [0, 1] to 8 bits; Pillow would clip it to 0 and 1."""
    values = numpy.asarray(image)
    if not (values.min() >= 0 and values.max() <= 1):
        raise ValueError(f"floating-point values from {values.min():g} to {values.max():g}; expected 0 to 1")
    return pillow.fromarray((255 * values).round().astype("uint8"))


def _tensor(image: pillow.Image) -> Tensor:
    return torch.from_numpy(numpy.array(image)).permute(2, 0, 1)
