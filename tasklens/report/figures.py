"""Figures of lenses: cross-section with rays; spot diagrams, PSFs and ray fans from axis to corner."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Circle
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.analysis.datasheet import view_of
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, ray_fans, spot_diagram, trace_fields, trace_fields_full
from tasklens.optics.aspheres import sag
from tasklens.optics.io import prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.files import read_tensors, replacing

_SHOWN = {0: "axis", 4: "middle", 8: "corner"}  # of the nine fields
_COLOURS = ("tab:blue", "tab:green", "tab:red")
_BY_WAVELENGTH = ("tab:red", "tab:green", "tab:blue")  # as in a specification: red, green, blue


@dataclass(frozen=True)
class Panel:
    """Contents of the figure of one lens.

    Attributes:
        title: title of the figure.
        lens: lens with finite clear apertures.
        view: fields, wavelengths and pixels.
        psf: (F, 3, K, K) cached PSFs.
        figures: optical figures in the lens file, for captions.
    """

    title: str
    lens: Lens
    view: View
    psf: Tensor
    figures: Mapping


def panel(title: str, path: Path, psf: Path) -> Panel:
    """Read what a panel shows from the files of a lens and its PSFs; raises FileError."""
    found, content = prescription.read(path)
    view = view_of(found.lens, content, str(path))
    return Panel(title, found.lens, view, read_tensors(psf)[0]["psf"], content["figures"])


def draw(path: Path, panels: Sequence[Panel]) -> None:
    """Draw one lens, or several one above the other, in the format of the suffix of `path`: .png, .svg or .pdf."""
    whole = Figure(figsize=(13, 6 * len(panels)), layout="constrained")
    for part, panel in zip(whole.subfigures(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        _draw(part, panel)
    with replacing(path) as temporary:
        whole.savefig(temporary, dpi=110, format=path.suffix.removeprefix("."))


def _draw(part: SubFigure, panel: Panel) -> None:
    lens, view, figures = panel.lens, panel.view, panel.figures
    grid = part.add_gridspec(3, 10)
    _cross_section(part.add_subplot(grid[:, :4]), lens, view)
    rays = trace_fields(lens, view, sobol_disc(1024, 0))
    spots = 1e3 * spot_diagram(rays, centroid(rays))[:, 1]
    fans = ray_fans(lens, view, 41)
    half = view.kernel_size * view.pixel_pitch / 2
    for k, (field, name) in enumerate(_SHOWN.items()):
        column = 4 + 2 * k
        axes = part.add_subplot(grid[0, column : column + 2])
        axes.scatter(spots[field, :, 0], spots[field, :, 1], s=0.3, color=_COLOURS[k])
        axes.add_patch(Circle((0, 0), figures["radius_80_um"][field], fill=False, ls="--", lw=0.8))
        axes.set(xlim=(-half, half), ylim=(half, -half), aspect="equal", xlabel="um")
        axes.set_title(f"{name}: RMS {figures['rms_centroid_um'][field]:.1f} um", fontsize=9, color=_COLOURS[k])
        axes = part.add_subplot(grid[1, column : column + 2])
        shown = panel.psf[field].permute(1, 2, 0)
        axes.imshow((shown / shown.max()).sqrt().numpy())  # square root, to make the tail visible
        axes.set_title(f"inside {figures['energy_in_window'][field]:.2f}", fontsize=9)
        axes.set(xticks=[], yticks=[])
        for i, (errors, label) in enumerate(((fans.tangential[..., 1], "py"), (fans.sagittal[..., 0], "px"))):
            axes = part.add_subplot(grid[2, column + i])
            for w, colour in enumerate(_BY_WAVELENGTH):
                axes.plot(fans.pupil, 1e3 * errors[field, w], color=colour, lw=0.8)
            axes.set(xlim=(-1, 1), ylim=(-half, half), xlabel=label)
            axes.set_title(f"e{label[1]} [um]", fontsize=9)
            axes.grid(lw=0.3)
    part.suptitle(f"{panel.title}: EFL {figures['efl_mm']:.3f} mm, F/{figures['f_number']:.2f}")


def _cross_section(axes: Axes, lens: Lens, view: View) -> None:
    """Draw a lens in the plane of the diagonal, with a fan of rays for axis, middle and corner."""
    vertices = lens.vertices
    edges = []
    for i in range(len(lens.media)):
        height = torch.linspace(-1, 1, 101, dtype=lens.dtype) * lens.semi_diameter[i]
        z = vertices[i] + sag(height**2, lens.curvature[i], lens.conic[i], lens.alpha[i])[0]
        edges.append((z, height))
        if i == lens.stop:
            for sign in (1, -1):
                rim = sign * float(lens.semi_diameter[i])
                axes.plot([float(vertices[i])] * 2, [rim, 1.4 * rim], color="black", lw=2)
        if i in lens.refracting_surfaces:
            axes.plot(z, height, color="black", lw=1)
    for i, medium in enumerate(lens.media[:-1]):
        if medium != AIR:
            for end in (0, -1):
                (z0, h0), (z1, h1) = edges[i], edges[i + 1]
                flange = max(h0[end], h1[end], key=abs)  # beyond its clear aperture a surface is a flat flange
                axes.plot([z0[end], z0[end], z1[end], z1[end]], [h0[end], flange, flange, h1[end]], color="black", lw=1)
    radius = view.fields.norm(dim=-1)[list(_SHOWN)]
    along_y = View(torch.stack([torch.zeros_like(radius), radius], -1), view.efl, view.wavelengths[1:2], 1.0, 1)
    fan = torch.stack([torch.zeros(9), torch.linspace(-0.98, 0.98, 9)], -1).double()
    image, behind = trace_fields_full(lens, along_y, fan)
    image_z = float(vertices[-1] + lens.thickness[-1])
    # Rays are drawn from the foremost plane straight to the first refracting surface, since a stop may be behind it.
    z_each = [behind[i].z[:, 0] + vertices[i] for i in lens.refracting_surfaces]
    y_each = [behind[i].y[:, 0] for i in lens.refracting_surfaces]
    front = torch.full_like(z_each[0], float(vertices.min()))
    before = y_each[0] - along_y.tangents[:, 1, None] * (z_each[0] - front)
    z = torch.stack([front, *z_each, torch.full_like(front, image_z)])
    y = torch.stack([before, *y_each, image.y[:, 0]])
    for k, colour in enumerate(_COLOURS):
        alive = image.valid[k, 0]
        axes.plot(z[:, k, alive].numpy(), y[:, k, alive].numpy(), color=colour, lw=0.6)
    half = float(view.fields.norm(dim=-1).max())
    axes.plot([image_z] * 2, [-half, half], color="black", lw=2)
    axes.set(aspect="equal", xlabel="z [mm]", ylabel="y [mm]")
