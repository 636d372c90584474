"""Panels of spots and PSFs on the sensor, y upward, centred on the image point of the chief ray."""

import torch
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from tasklens.optics.analysis.spots import spot_diagram
from tasklens.optics.view import View
from tasklens.show.panel import BY_WAVELENGTH, Panel, scale_bar

_DRAWN = 700  # rays of a spot
_DECADES = 4.0  # of the logarithmic PSFs
_ROUND = (
    Line2D([], [], marker="o", mfc="none", mec="black", ms=9, lw=0, label="core: 50 % about the chief ray"),
    Line2D([], [], color="black", ls="--", lw=0.9, label="80 % about the chief ray"),
    Line2D([], [], marker="o", mfc="none", mec="grey", ms=5, lw=0, label="Airy radius"),
)
_LEAST_LABELLED = 5e-4  # smallest share of light that a label mentions


def draw_spots(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the spots of all fields from axis to corner, with circles of 50 % and 80 % of the light, and Airy's."""
    view, figures, half_um = panel.view, panel.figures, panel.shown_um
    points = 1e3 * spot_diagram(panel.rays, panel.centre)[:, :, :_DRAWN]
    order = _by_radius(view)
    all_axes = part.subplots(1, len(order), squeeze=False)[0]
    for axes, field in zip(all_axes, order, strict=True):
        for w, (wavelength, style) in enumerate(zip(view.wavelengths_um, BY_WAVELENGTH, strict=False)):
            x, y = points[field, w].unbind(-1)
            axes.scatter(x, y, s=1.2, lw=0, color=style["color"], rasterized=True)
            axes.plot([], [], "o", color=style["color"], ms=4, label=f"{1e3 * wavelength:.0f} nm")
        circles = (
            Circle((0, 0), figures["core_radius_um"][field], fill=False, lw=1.2),
            Circle((0, 0), figures["radius_80_um"][field], fill=False, ls="--", lw=0.9),
        )
        axes.add_patch(Circle((0, 0), figures["airy_radius_um"], fill=False, color="grey", lw=0.8))
        for circle in circles:
            if circle.radius < 1e3 * half_um:  # an infinite circle cannot be drawn
                axes.add_patch(circle)
        axes.plot(0, 0, "+", color="black", ms=5, lw=0, label="chief ray")
        axes.set(xlim=(-half_um, half_um), ylim=(-half_um, half_um), aspect="equal", xticks=[], yticks=[])
        x_mm, y_mm = view.fields[field].tolist()
        axes.set_title(f"{figures['angle_deg'][field]:.1f}°\n({x_mm:.2f}, {y_mm:.2f}) mm", fontsize=8)
        sizes = f"RMS {figures['rms_centroid_um'][field]:.1f} um\ncore {_um(figures['core_radius_um'][field])}"
        lost = 1 - figures["valid_fraction"][field]
        axes.set_xlabel(f"{sizes}, {lost:.1%} lost" if lost >= _LEAST_LABELLED else sizes, fontsize=8)
    scale_bar(all_axes[-1], "um")
    handles = [*all_axes[-1].get_legend_handles_labels()[0], *_ROUND]
    part.legend(handles=handles, loc="outside upper center", ncol=7, fontsize=8, frameon=False, borderaxespad=0)


def _um(value: float) -> str:
    return f"{value:.1f} um" if value < 1e6 else "not reached"


def _by_radius(view: View) -> list[int]:
    """Return the indices of the fields from the axis to the corner."""
    return torch.argsort(view.radii, stable=True).tolist()


def draw_psfs(part: SubFigure | Figure, panel: Panel) -> None:
    """Draw the PSFs of all fields from axis to corner: square root above, four decades of the logarithm below."""
    psf, view, figures = panel.psf, panel.view, panel.figures
    order = _by_radius(view)
    grid = part.subplots(2, len(order), squeeze=False)
    half = view.kernel_size * view.pixel_pitch_um / 2
    for column, field in enumerate(order):
        shares = psf[field].permute(1, 2, 0) / psf[field].max().clamp(min=1e-30)
        logarithm = (1 + shares.clamp(min=1e-30).log10() / _DECADES).clamp(0, 1)
        for axes, image in zip(grid[:, column], (shares.clamp(0, 1).sqrt(), logarithm), strict=True):
            axes.imshow(image.numpy(), origin="lower", extent=(-half, half, -half, half))
            axes.set(xticks=[], yticks=[])
        grid[0, column].set_title(f"{figures['angle_deg'][field]:.1f}°", fontsize=9)
        inside = figures["energy_in_window"][field]
        grid[1, column].set_xlabel("all inside" if 1 - inside < _LEAST_LABELLED else f"{inside:.1%} inside", fontsize=8)
    for axes, label in zip(grid[:, 0], ("square root", f"{_DECADES:.0f} decades"), strict=True):
        axes.set_ylabel(label, fontsize=8)
    for axes in grid[:, -1]:
        scale_bar(axes, "um", "white", panel.narrowest_um)
