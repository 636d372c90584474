"""Lenses: read, define, write, trace, draw."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from tasklens.materials.catalogues import is_ours
from tasklens.materials.library import Library, user_files
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.focus import refocus
from tasklens.optics.analysis.paraxial import check_focal_length
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import evaluation_psf, trace_fields
from tasklens.optics.io import lens_files
from tasklens.optics.io.lens_specs import check_distance, with_specification
from tasklens.optics.io.prescription import Prescription, with_system_data
from tasklens.optics.io.spec_section import spec_of
from tasklens.optics.io.typed import prescription_of
from tasklens.optics.io.zemax_glasses import NamedGlasses
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import as_path, as_paths
from tasklens.runtime.tensors import as_tensor, explain_errors
from tasklens.settings.specification import Spec
from tasklens.show.figures import figure_of
from tasklens.show.panel import Panel


def load_lens(
    path: str | Path,
    catalogues: str | Path | Sequence[str | Path] = (),
    *,
    field_of_view_deg: float | None = None,
    f_number: float | None = None,
    pixel_pitch_um: float | None = None,
    kernel_size: int | None = None,
    wavelengths_um: Sequence[float] | None = None,
    object_distance_mm: float | None = None,
    configuration: int | None = None,
    focus: str | float | None = None,
) -> tuple[Lens, View]:
    """Read a lens and its specification from a lens.yaml or a Zemax file (.zmx).

    A value that is given overrides the file.

    Args:
        path: the file.
        catalogues: glass catalogues of a Zemax file (.agf, or plastics in YAML).
        field_of_view_deg: full angle.
        f_number: focal length / entrance pupil diameter.
        pixel_pitch_um, kernel_size: pixel pitch, and width of PSFs in pixels, odd.
        wavelengths_um: wavelengths; the middle one is the reference.
        object_distance_mm: from the object to the first vertex, or infinity.
        configuration: of a Zemax file with several.
        focus: image plane: "file"; "mtf" or "spot", where these are best; or its shift away from the lens [um]. None:
            as in the file, but at the peak of the MTF if the object is at another distance.

    Returns:
        The lens, and the view: nine fields from the axis to the corner, wavelengths, pixels, object distance. If the
        file lacks a value, a warning states the assumption.

    Raises:
        InputError: the message names the file, what is wrong, and what to do.

    Example:
        >>> lens, view = tasklens.load_lens("triplet.zmx", ["SCHOTT.AGF"], pixel_pitch_um=3.0)
    """
    files = [*as_paths(catalogues, "catalogues"), *user_files()]
    file = lens_files.read(
        as_path(path, "path"),
        files,
        configuration,
        object_distance_mm=object_distance_mm,
        wavelengths_um=wavelengths_um,
        field_of_view_deg=field_of_view_deg,
        f_number=f_number,
        pixel_pitch_um=pixel_pitch_um,
        kernel_size=kernel_size,
        focus=focus,
    )
    for remark in file.remarks:
        warnings.warn(f"{path}: {remark}", stacklevel=2)
    return file.lens, file.view


def lens(
    surfaces: Sequence[Mapping[str, Any]],
    field_of_view_deg: float,
    f_number: float | None = None,
    wavelengths_um: Sequence[float] = Spec.model_fields["wavelengths_um"].default,
    object_distance_mm: float = math.inf,
    catalogues: str | Path | Sequence[str | Path] = (),
    *,
    pixel_pitch_um: float | None = None,
    kernel_size: int | None = None,
) -> tuple[Lens, View]:
    """Return a lens defined surface by surface, from the object to the image, and its view.

    Args:
        surfaces: for each surface, `radius` [mm] (inf for a plane) or `curvature`, `thickness` to the next one [mm],
            `material` behind it (its name, or nd and Vd as in a patent, such as (1.5445, 55.9); air if absent),
            `conic`, coefficients `alpha_2`, `alpha_4` .. of r^2, r^4 .. [mm^(1 - 2j)], `semi_diameter` of its clear
            aperture [mm], and `stop: True` for one surface. If the last `thickness` is absent, the image plane is
            placed at best focus.
        field_of_view_deg: full angle.
        f_number: focal length / entrance pupil diameter; None: the stop must have a `semi_diameter`.
        wavelengths_um: wavelengths; the middle one is the reference; by default the lines C, D, F, as in a study.
        object_distance_mm: from the object to the first vertex.
        catalogues: glass catalogues (.agf, .yaml) in addition to the built-in catalogues.
        pixel_pitch_um, kernel_size: pixel pitch, and width of PSFs in pixels, odd; None: the defaults of a study.

    Raises:
        InputError: the message names the surface, what is wrong, and what to do.

    Example:
        >>> lens, view = tasklens.lens(
        ...     [
        ...         {"radius": 51.7, "thickness": 8.0, "material": "N-BK7", "stop": True},
        ...         {"radius": -42.0, "thickness": 2.5, "material": "N-SF5"},
        ...         {"radius": -140.0},
        ...     ],
        ...     field_of_view_deg=4,
        ...     f_number=4,
        ... )
    """
    check_distance(object_distance_mm)
    prescription = prescription_of(surfaces, Library([*as_paths(catalogues, "catalogues"), *user_files()]))
    if f_number is not None and "semi_diameter" in surfaces[stop := prescription.lens.stop]:
        raise InputError(f"surface {stop}: expected either the `semi_diameter` of the stop or an F-number, not both")
    file = with_specification(
        replace(prescription, object_distance_mm=float(object_distance_mm)),
        content={},
        name="",
        wavelengths_um=wavelengths_um,
        field_of_view_deg=field_of_view_deg,
        f_number=f_number,
        pixel_pitch_um=Spec().pixel_pitch_um if pixel_pitch_um is None else pixel_pitch_um,
        kernel_size=Spec().kernel_size if kernel_size is None else kernel_size,
    )
    if "thickness" not in surfaces[-1]:
        check_focal_length(file.lens, file.view.reference_um, "the last thickness is missing, and a focus needs")
        file = replace(file, lens=refocus(file.lens, file.view))
    for remark in file.remarks:
        warnings.warn(remark, stacklevel=2)
    return file.lens, file.view


@explain_errors
def draw(lens: Lens, view: View, title: str = "", rays: int = 4096) -> Figure:
    """Draw a lens: cross-section with rays, spots, PSFs, ray fans, MTF by field and focus, distortion.

    Args:
        title: heading of the figure.
        rays: number of rays of each field and wavelength.

    Returns:
        A matplotlib figure: a notebook displays it, `savefig` writes it.

    Example:
        >>> tasklens.draw(lens, view).savefig("lens.pdf")
    """
    return figure_of([Panel.compute(title, lens, view, rays)])


@explain_errors
def save_lens(path: str | Path, lens: Lens, view: View, notes: Mapping[str, Any] | None = None) -> None:
    """Write a lens as a lens.yaml, or as a Zemax file if the suffix is .zmx; an existing file is replaced.

    Title, comments and kind of fields of the file that it was loaded from are lost; `tasklens lens export` keeps them.

    Args:
        path: the file.
        notes: notes on the lens from `design_lens`; by default, its specification and figures.

    Raises:
        InputError: a number of the lens is not finite, as after a descent that diverged; or a glass catalogue beside a
            Zemax file, which the lens needs, has its name and is not ours.

    Example:
        >>> tasklens.save_lens("lens.zmx", lens, view)
    """
    if not isinstance(lens, Lens) or not isinstance(view, View):
        raise InputError("save_lens: expected a path, a lens and its view, in this order")
    if bad := lens.not_finite:
        raise InputError(f"{path}: {bad} of the lens is not finite; nothing was written")
    path = as_path(path, "path")
    catalogue = path.with_suffix(".agf")
    needs_catalogue = path.suffix.lower() == ".zmx" and NamedGlasses.of(lens.media, catalogue.stem).own
    if needs_catalogue and catalogue.is_file() and not is_ours(catalogue):
        raise InputError(f"{catalogue}: already exists, and is not ours; choose another name for the lens")
    prescription = with_system_data(Prescription(lens.detached()), view)
    lens_files.write(path, prescription, notes or {"spec": spec_of(view), "figures": figures(lens, view, rays=4096)})


@torch.compiler.disable
@explain_errors
def trace(lens: Lens, view: View, rays: int | None = None, pupil: Tensor | None = None) -> Rays:
    """Trace rays of all F fields and W wavelengths to the image plane; differentiable in the lens.

    Args:
        rays: number N of rays for each field and wavelength, evenly distributed over the stop, by default 256.
        pupil: (N, 2) points in the unit disc at which rays pass the stop, instead of `rays`.

    Returns:
        Rays on the image plane: positions `x`, `y` [mm] and direction cosines `l`, `m`, `n`, each (F, W, N); `valid`
        is false for lost rays.

    Raises:
        InputError: both `rays` and `pupil`, or either of another kind.

    Example:
        >>> rays = tasklens.trace(lens, view, rays=64)
        >>> rays.x[rays.valid].std()
    """
    if rays is not None and pupil is not None:
        raise InputError("rays: not with `pupil`, which has the points")
    points = sobol_disc(256 if rays is None else rays, seed=0) if pupil is None else as_tensor(pupil, "pupil")
    if points.dim() != 2 or points.shape[1] != 2:
        raise InputError(f"pupil: expected points (N, 2), got {tuple(points.shape)}")
    return trace_fields(lens, view, points)


@torch.compiler.disable
@explain_errors
def psf(lens: Lens, view: View, rays: int = 4096, diffraction: bool = False) -> Tensor:
    """Compute the point spread functions of all F fields and W wavelengths; differentiable in the lens.

    Args:
        rays: number of rays of each field and wavelength.
        diffraction: sum plane waves instead of counting rays; takes half a minute.

    Returns:
        (F, W, K, K) energies on the sensor's pixels around the chief ray, in the order of `view.wavelengths_um`
        (`view.in_colours()`: red, green, blue); rows run along y, columns along x. Each PSF sums to the fraction of the
        light inside the window; a warning says if that is less than half at a field.

    Example:
        >>> tasklens.psf(lens, view).sum((-2, -1))  # energy inside the window
    """
    grid = evaluation_psf(lens, view, rays, diffraction)
    if remark := window_remark(energy_inside(grid), view.kernel_size):
        warnings.warn(remark, stacklevel=4)  # two decorators are in between
    return grid


@explain_errors
def analyse(lens: Lens, view: View, rays: int = 4096) -> dict[str, Any]:
    """Compute the optical figures of a lens; names end in their unit, lists have one entry per field.

    The figures include efl_mm, f_number, track_mm, rms_centroid_um, radius_80_um, mtf_tangential_half_nyquist,
    distortion_percent, relative_illumination, seidel_um.

    Args:
        rays: number of rays of each field and wavelength.

    Example:
        >>> tasklens.analyse(lens, view)["rms_centroid_um"]
    """
    return figures(lens, view, rays)
