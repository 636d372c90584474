"""What a notebook needs: `import tasklens`, and these functions.

A lens is a `Lens` (surfaces, distances, media: tensors that gradients flow through) and is looked at with a `View`
(fields, wavelengths, pixels). Lengths are in mm, wavelengths, pixels and spots in um.

    import tasklens

    lens, view = tasklens.load_lens("lens.yaml")
    tasklens.analyse(lens, view)["rms_centroid_um"]
    captures = tasklens.simulate("photograph.jpg", lens, view)
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy
import torch
from torch import Tensor

from tasklens.materials.library import users_files
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import evaluation_psf, trace_fields
from tasklens.optics.io import lens_files
from tasklens.optics.io.prescription import Prescription, with_use
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError

# torch causes this warning itself, at the first forward-mode derivative of a process.
warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)

if TYPE_CHECKING:
    from tasklens.study.settings import SensorSettings


def load_lens(path: str | Path, catalogues: Sequence[str | Path] = (), **specification: Any) -> tuple[Lens, View]:
    """Read a lens and its specification from a lens.yaml or a Zemax file (.zmx).

    Args:
        path: the file.
        catalogues: glass catalogues of a Zemax file (.agf, or plastics in YAML).
        specification: what differs from the file: field_of_view_deg (full angle), f_number, pixel_pitch_um, kernel_size
            (width of PSFs in pixels, odd), wavelengths_um (the middle one is the reference), object_distance_mm (from
            the object to the first vertex, or infinity); configuration (of a Zemax file with several).

    Returns:
        The lens, and the view: nine fields from the axis to the corner, wavelengths, pixels, object distance. What was
        assumed about them, since the file does not say it, is a warning.

    Raises:
        InputError: the message names the file, what is wrong, and what to do.

    Example:
        >>> lens, view = tasklens.load_lens("triplet.zmx", ["SCHOTT.AGF"], pixel_pitch_um=3.0)
    """
    files = [*(Path(catalogue) for catalogue in catalogues), *users_files()]
    file = lens_files.read(Path(path), files, **specification)
    for remark in file.remarks:
        warnings.warn(f"{path}: {remark}", stacklevel=2)
    return file.lens, file.view


def save_lens(path: str | Path, lens: Lens, view: View, notes: Mapping[str, Any] | None = None) -> None:
    """Write a lens as a lens.yaml, or by the suffix .zmx for Zemax; a file of that name is replaced.

    Args:
        path: the file.
        notes: what `design` says of the lens; by default its specification and figures.

    Example:
        >>> tasklens.save_lens("lens.zmx", lens, view)
    """
    found = with_use(Prescription(lens.detached()), view)
    lens_files.write(Path(path), found, notes or described(lens, view))


def described(lens: Lens, view: View, rays: int = 4096) -> dict[str, Any]:
    """Return the specification and the figures of a lens, as a lens.yaml has them."""
    spec = {
        "fields_mm": view.fields.tolist(),
        "efl_mm": view.efl,
        "wavelengths_um": list(view.wavelengths),
        "pixel_pitch_um": view.pixel_pitch,
        "kernel_size": view.kernel_size,
    }
    return {"spec": spec, "figures": figures(lens, view, rays)}


def trace(lens: Lens, view: View, rays: int = 256, pupil: Tensor | None = None) -> Rays:
    """Trace rays of all F fields and W wavelengths through the lens to the image plane, differentiably in the lens.

    Args:
        rays: N, the number of rays of each field and wavelength, spread evenly over the stop.
        pupil: (N, 2) points of the unit disc in place of these, where the rays pass the stop.

    Returns:
        Rays on the image plane: positions `x`, `y` [mm] and direction cosines `l`, `m`, `n`, each (F, W, N); `valid`
        is false for lost rays.

    Example:
        >>> rays = tasklens.trace(lens, view, rays=64)
        >>> rays.x[rays.valid].std()
    """
    return trace_fields(lens, view, sobol_disc(rays, seed=0) if pupil is None else pupil)


def psf(lens: Lens, view: View, rays: int = 4096, diffraction: bool = False) -> Tensor:
    """Compute the point spread functions of all F fields and W wavelengths, differentiably in the lens.

    Args:
        rays: number of rays of each field and wavelength.
        diffraction: sums of plane waves in place of counted rays; takes half a minute.

    Returns:
        (F, W, K, K) energies on the sensor's pixels around the chief ray; rows run along y, columns along x. Each sums
        to the fraction of the light that is inside the window.

    Example:
        >>> tasklens.psf(lens, view).sum((-2, -1))  # energy inside the window
    """
    return evaluation_psf(lens, view, rays, diffraction)


def simulate(
    image: str | Path | numpy.ndarray | Tensor,
    lens: Lens,
    view: View,
    fields: Sequence[tuple[float, float]] | None = None,
    *,
    colour: str = "srgb",
    outside_window: str = "veil",
    sensor: "SensorSettings | None" = None,
    rays: int = 4096,
    diffraction: bool = False,
) -> Tensor:
    """Render what the sensor sees of an image through the lens, once for each field, as if all of it lay there.

    Args:
        image: a file; an array (H, W, 3) of uint8, or of floats in [0, 1]; or a tensor (3, H, W) in [0, 1].
        fields: points (x, y) on the sensor [mm]; None: the F fields of the view.
        colour: "srgb" convolves the values of the image, "linear" its light.
        outside_window: light beside the PSF window returns as a "veil", or is removed: "renormalise".
        sensor: noise and levels, a `tasklens.study.settings.SensorSettings`; None: none.
        rays, diffraction: as in `psf`.

    Returns:
        (F, 3, H, W) captures, differentiable in the image and in the lens, whose relative illumination is held.

    Raises:
        InputError: the image cannot be read, or is smaller than half a PSF.

    Example:
        >>> captures = tasklens.simulate("cat.jpg", lens, view, fields=[(0, 0), (1.7, 1.0)])
    """
    from tasklens.imaging import Camera

    source = _image(image)
    _one_of(colour, "srgb", "linear")
    _one_of(outside_window, "veil", "renormalise")
    if fields is not None:
        points = torch.tensor(fields, dtype=view.fields.dtype).reshape(-1, 2)
        view = replace(view, fields=points)
    if view.kernel_size // 2 >= min(source.shape[-2:]):
        height, width = source.shape[-2:]
        raise InputError(
            f"an image of {width} x {height} pixels is too small for PSFs of {view.kernel_size} pixels: take a larger "
            "one, or a smaller kernel_size (--kernel-size)"
        )
    view = view.in_colours()
    grid = psf(lens, view, rays, diffraction)
    camera = Camera(grid, outside_window, colour, sensor, relative_illumination(lens.detached(), view))
    return camera.grid(source[None])[:, 0]


def simulate_sensor(
    image: str | Path | numpy.ndarray | Tensor,
    lens: Lens,
    view: View,
    pixel_pitch_um: float | None = None,
    *,
    colour: Literal["srgb", "linear"] = "srgb",
    distortion: bool = False,
    illumination: bool = False,
    rays: int = 4096,
) -> Tensor:
    """Render what the whole sensor sees of an image through the lens: the PSF changes from axis to corner.

    Args:
        image: as in `simulate`, of any size; its centre is on the axis.
        pixel_pitch_um: width of a pixel of the image; None: the one at which the image fills the sensor.
        colour: "srgb" convolves the values of the image, "linear" its light.
        distortion: distort the image; otherwise it has the geometry of a pinhole camera.
        illumination: darken the image towards its corners; otherwise exposure makes up for it.
        rays: number of rays of each PSF and colour.

    Returns:
        (3, H, W) capture, differentiable in the image and in the lens, whose relative illumination is held.

    Raises:
        InputError: the image cannot be read or is too small, or the lens has no image at its corners.

    Example:
        >>> capture = tasklens.simulate_sensor("cat.jpg", lens, view)  # 1080 x 1920: a quarter of a minute
    """
    from tasklens.simulation import sensor

    _one_of(colour, "srgb", "linear")
    return sensor.simulate(
        lens, view.in_colours(), _image(image), pixel_pitch_um, rays, colour, distortion, illumination
    )


def analyse(lens: Lens, view: View, rays: int = 4096) -> dict[str, Any]:
    """Compute the optical figures of a lens; each name ends in its unit, a list has one entry per field.

    Among them: efl_mm, f_number, track_mm, rms_centroid_um, radius_80_um, mtf_tangential_half_nyquist,
    distortion_percent, relative_illumination, seidel_um.

    Args:
        rays: number of rays of each field and wavelength.

    Example:
        >>> tasklens.analyse(lens, view)["rms_centroid_um"]
    """
    return figures(lens, view, rays)


def _one_of(value: str, *known: str) -> None:
    if value not in known:
        raise InputError(f"expected {' or '.join(known)}, got {value!r}")


def _image(image: str | Path | numpy.ndarray | Tensor) -> Tensor:
    """Return an image as a tensor (3, H, W) in [0, 1]; raises InputError."""
    if isinstance(image, str | Path):
        from tasklens.recognition.folders import read_whole

        if not Path(image).is_file():
            raise FileError(f"{image}: no such image")
        return read_whole(Path(image)).float() / 255
    found = torch.as_tensor(image)
    if isinstance(image, numpy.ndarray):
        found = found.movedim(-1, 0) if found.dim() == 3 else found
    if found.dim() != 3 or found.shape[0] != 3:
        raise InputError(f"image: expected an array (H, W, 3) or a tensor (3, H, W), got {tuple(image.shape)}")
    return found.float() / 255 if found.dtype == torch.uint8 else found.float()
