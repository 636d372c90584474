"""Curves of a lens: ray fans, MTF by frequency and focus, encircled energy; spot, MTF and distortion by field."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from torch import Tensor

from tasklens.optics.analysis.aberrations import field_curvature
from tasklens.optics.analysis.mtf import limited_mtf, perfect_mtf
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import (
    centroid,
    chief_rays,
    chief_scale,
    distortion,
    encircled_energy,
    ray_fans,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View
from tasklens.show.panel import BY_WAVELENGTH, FIELD_COLOURS, Panel

_FANS = 41  # rays of a fan
_MARKERS = ("o", "s", "^")  # of the drawn fields
_FREQUENCIES = 41
_RADII_UM = (0.5, 500.0)
_SHIFTS = 129  # number of shifts of the image plane
_DEPTHS = (8, 16, 32)  # largest shift, in pixel pitches times the F-number: the first that shows all peaks
_BEYOND = 1.25  # shown range, as a multiple of the shift of the farthest peak
_SLOWEST = 1e3  # F-number; that of an afocal lens is infinite
_FIELDS, _RAYS = 51, 1024  # from the axis to the corner; rays of each and of each wavelength


def draw_ray_fans(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the transverse errors of rays across the pupil: along the field (T) and across it (S), in its meridian."""
    pupil, tangential, sagittal = ray_fans(panel.lens, panel.view, _FANS)
    half_um = panel.shown_um
    all_axes = part.subplots(1, 2 * len(panel.field_names), sharey=True, squeeze=False)[0]
    for k, (field, name) in enumerate(panel.field_names.items()):
        for i, (errors, label) in enumerate(((tangential[..., 1], "T"), (sagittal[..., 0], "S"))):
            axes = all_axes[2 * k + i]
            for w, (wavelength, style) in enumerate(zip(panel.view.wavelengths_um, BY_WAVELENGTH, strict=False)):
                axes.plot(pupil, 1e3 * errors[field, w], lw=1, label=f"{1e3 * wavelength:.0f} nm", **style)
            axes.set(xlim=(-1, 1), ylim=(-half_um, half_um), xticks=(-1, 0, 1))
            axes.set_title(f"{name} {label}", fontsize=9)
            axes.tick_params(labelsize=8)
            axes.grid(lw=0.3)
    all_axes[0].set_ylabel("transverse ray error [um]", fontsize=8)
    part.supxlabel("pupil; T along the field, S across it", fontsize=8)
    part.legend(*all_axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=3, fontsize=8, frameon=False)


def draw_curves(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw MTF and encircled energy of axis, middle and corner."""
    left, right = part.subplots(1, 2)
    _draw_mtf(left, panel)
    _draw_encircled_energy(right, panel)


def draw_sharpness(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw RMS spot and MTF against the field."""
    spot, mtf = part.subplots(1, 2)
    view, angles = _along_radius(panel.view)
    rays = trace_fields(panel.lens, view, sobol_disc(_RAYS, seed=0))
    radius = 1e3 * rms_spot_radius(rays, centroid(rays))
    spot.plot(angles, torch.where(radius.isfinite(), radius, torch.nan), color="black", lw=1)
    spot.set(xlabel="field [degrees]", title="RMS spot about the centroid [um]")
    spot.set_ylim(bottom=0)
    frequency = panel.figures["nyquist_per_mm"] / 2
    for values, style, label in zip(_mtf(rays, view, [frequency]), ("-", "--"), "TS", strict=True):
        mtf.plot(angles, values[:, 0], color="black", lw=1, ls=style, label=label)
    mtf.set(ylim=(0, 1.02), xlabel="field [degrees]", title=f"MTF at {frequency:.0f} cycles/mm")
    for axes in (spot, mtf):
        _finish(axes)


def draw_focus(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw MTF against focus, field curvature and distortion; gaps where the chief ray is lost."""
    by_focus, curvature, distorted = part.subplots(1, 3)
    view, angles = _along_radius(panel.view)
    _draw_mtf_by_focus(by_focus, panel, panel.figures["nyquist_per_mm"] / 2)
    _draw_focus_by_field(curvature, panel.lens, view, angles)
    _draw_distortion(distorted, panel.lens, view, angles)


def _along_radius(view: View) -> tuple[View, Tensor]:
    """Return fields from the axis to the corner, along y, and their angles [deg]."""
    heights = torch.linspace(0, 1, _FIELDS, dtype=view.fields.dtype) * view.radii.max()
    return view.along_y(heights), torch.rad2deg(torch.atan(heights / view.efl))


def _draw_mtf(axes: Axes, panel: Panel) -> None:
    """Draw the MTF up to the Nyquist frequency: T solid, S dashed, a perfect lens on the axis grey."""
    nyquist, cutoff = panel.figures["nyquist_per_mm"], panel.figures["diffraction_cutoff_per_mm"]
    frequencies = torch.linspace(0, nyquist, _FREQUENCIES, dtype=torch.float64)
    limit = perfect_mtf(frequencies, cutoff)
    tangential, sagittal = _mtf(panel.rays, panel.view, frequencies.tolist())
    for k, ((field, name), colour) in enumerate(zip(panel.field_names.items(), FIELD_COLOURS, strict=False)):
        marker: Any = {"color": colour, "marker": _MARKERS[k], "markevery": 8, "ms": 3, "lw": 1}
        axes.plot(frequencies, tangential[field], label=f"{name} T", **marker)
        axes.plot(frequencies, sagittal[field], ls="--", mfc="white", label=f"{name} S", **marker)
    axes.plot(frequencies, limit, color="grey", lw=1, ls=":", label="perfect, axis")
    axes.set(
        xlim=(0, nyquist), ylim=(0, 1.02), xlabel="cycles/mm, up to Nyquist", title="MTF: geometric × diffraction limit"
    )
    _finish(axes)


def _draw_encircled_energy(axes: Axes, panel: Panel) -> None:
    """Draw the share of the light within a radius of the chief ray's image point."""
    view = panel.view
    low, high = (torch.tensor(radius).log10().item() for radius in _RADII_UM)
    radii = torch.logspace(low, high, 81, dtype=torch.float64)
    energy = encircled_energy(panel.rays, panel.centre, radii / 1e3)
    for k, ((field, name), colour) in enumerate(zip(panel.field_names.items(), FIELD_COLOURS, strict=False)):
        axes.plot(radii, energy[field], color=colour, marker=_MARKERS[k], markevery=10, ms=3, lw=1, label=name)
    axes.axhline(0.5, color="grey", lw=0.6)
    axes.axvline(view.pixel_pitch_um, color="grey", lw=1, ls=":", label="a pixel")
    axes.axvline(panel.figures["airy_radius_um"], color="grey", lw=1, ls="-.", label="Airy radius")
    half = view.kernel_size * view.pixel_pitch_um / 2
    axes.axvline(half, color="grey", lw=1, ls="--", label="PSF window")
    axes.set(xscale="log", xlim=_RADII_UM, ylim=(0, 1.02))
    axes.set(xlabel="radius about the chief ray [um]", title="encircled energy, by rays")
    axes.xaxis.set_major_formatter("{x:g}")
    _finish(axes)


def _draw_mtf_by_focus(axes: Axes, panel: Panel, frequency: float) -> None:
    """Draw the MTF at one frequency against the shift of the image plane, as far as all its peaks."""
    view, shown = panel.view, list(panel.field_names)
    rays = replace(panel.rays, **{name: value[shown] for name, value in vars(panel.rays).items()})
    depth = view.pixel_pitch_um * min(abs(panel.figures["f_number"]), _SLOWEST)
    shifts = depth * torch.linspace(-_DEPTHS[-1], _DEPTHS[-1], _SHIFTS, dtype=torch.float64)
    values = torch.stack(
        [
            torch.cat(_mtf(_on_plane(rays, shift), replace(view, fields=view.fields[shown]), [frequency]), -1)
            for shift in (shifts / 1e3).tolist()
        ]
    )  # (shift, field, direction)
    peaks = shifts[values.argmax(0)][values.amax(0) > 0]  # a field without light has none
    farthest = float(peaks.abs().max()) if len(peaks) else 0.0
    half = depth * next((d for d in _DEPTHS if d * depth > _BEYOND * farthest), _DEPTHS[-1])
    for k, (name, colour) in enumerate(zip(panel.field_names.values(), FIELD_COLOURS, strict=False)):
        for direction, style in enumerate(("-", "--")):
            label = f"{name} {'TS'[direction]}"
            marker: Any = {"marker": _MARKERS[k], "markevery": 8, "ms": 3}
            axes.plot(shifts, values[:, k, direction], color=colour, lw=1, ls=style, label=label, **marker)
    title = f"MTF at {frequency:.0f} cycles/mm through focus"
    axes.set(xlim=(-half, half), ylim=(0, 1.02), xlabel="image plane moved by [um]", title=title)
    _finish(axes)


def _mtf(rays: Rays, view: View, frequencies: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Compute the MTF of all charts, tangential and sagittal: geometric, times the diffraction limit."""
    return limited_mtf(rays, view.directions, frequencies, view.reference_um)


def _on_plane(rays: Rays, shift: float) -> Rays:
    """Return rays on an image plane that is moved by `shift` [mm]."""
    return replace(rays, x=rays.x + shift * rays.l / rays.n, y=rays.y + shift * rays.m / rays.n)


def _draw_focus_by_field(axes: Axes, lens: Lens, view: View, angles: Tensor) -> None:
    """Draw the tangential and sagittal focus of rays near the chief ray against the field."""
    tangential, sagittal = field_curvature(lens, view)
    axes.plot(1e3 * tangential, angles, color="black", lw=1, label="T")
    axes.plot(1e3 * sagittal, angles, color="black", lw=1, ls="--", label="S")
    axes.set(xlabel="focus from the image plane [um]", ylabel="field [degrees]", title="field curvature")
    _finish(axes)


def _draw_distortion(axes: Axes, lens: Lens, view: View, angles: Tensor) -> None:
    """Draw the distortion against the field."""
    chief = chief_rays(lens, view)
    points = torch.cat([chief.x[:, 0], chief.y[:, 0]], -1)
    percent = 100 * distortion(view.fields * chief_scale(lens, view), points)
    axes.plot(torch.where(chief.valid[:, 0, 0], percent, torch.nan), angles, color="black", lw=1)
    axes.locator_params(axis="x", nbins=4)
    axes.set(xlabel="distortion [%]", title="distortion")
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.title.set_fontsize(9)
    axes.xaxis.label.set_fontsize(8)
    axes.tick_params(labelsize=8)
    axes.grid(lw=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7)
