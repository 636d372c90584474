"""Cross-section of a lens in the plane of the diagonal, with rays of several fields."""

import math
from typing import Any

import torch
from matplotlib.axes import Axes

from tasklens.materials.material import AIR, short_name
from tasklens.optics.analysis.pupil import launch_fields
from tasklens.optics.aspheres import sag
from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import trace_full
from tasklens.optics.view import View
from tasklens.show.panel import FIELD_COLOURS, scale_bar, shown_fields

_RAYS = 9  # of a field
_ROWS = 3  # rows for the names of materials
_FOOT = 0.35  # height of these rows and the scale bar, in half heights of the lens
_PUPIL = 0.98  # outermost rays, in radii of the pupil
_ELEMENT: Any = {"facecolor": "#DCE6F0", "edgecolor": "black", "lw": 1}


def cross_section(axes: Axes, lens: Lens, view: View, narrowest_mm: float = math.inf) -> None:
    """Draw elements, stop, sensor and rays to axis, middle and corner; the scale bar fits `narrowest_mm`."""
    vertices = lens.vertices
    edges = []
    for i in range(len(lens.media)):
        height = torch.linspace(-1, 1, 101, dtype=lens.dtype) * lens.semi_diameter[i]
        z = vertices[i] + sag(height**2, lens.curvature[i], lens.conic[i], lens.alpha[i])[0]
        edges.append((z, height))
        if i == lens.stop:
            for sign in (1, -1):
                rim = sign * float(lens.semi_diameter[i])
                label = "stop" if sign == 1 else None
                axes.plot([float(vertices[i])] * 2, [rim, 1.4 * rim], color="black", lw=2.5, label=label)
    names = []
    for i, medium in enumerate(lens.media[:-1]):
        if medium != AIR:
            (z0, h0), (z1, h1) = edges[i], edges[i + 1]
            # A surface continues as a flat flange beyond its clear aperture.
            flange = float(max(h0[-1], h1[-1]))
            z = torch.cat([z0[:1], z0, z0[-1:], z1[-1:], z1.flip(0), z1[:1]])
            end = torch.tensor([flange], dtype=lens.dtype)
            axes.fill(z, torch.cat([-end, h0, end, end, h1.flip(0), -end]), **_ELEMENT)
            middle = float(vertices[i] + lens.thickness[i] / 2)
            names.append((middle, short_name(medium)))
    _draw_rays(axes, lens, view)
    image_z = float(vertices[-1] + lens.thickness[-1])
    half = float(view.radii.max())
    axes.plot([image_z] * 2, [-half, half], color="black", lw=2.5)
    axes.text(image_z, half, "sensor", ha="center", va="bottom", fontsize=8)
    base = min(-half, *(-float(height.max()) for _, height in edges if height.isfinite().all()))
    for k, (middle, name) in enumerate(names):  # in rows, so that names do not overlap
        axes.text(middle, base, "\n" * (k % _ROWS) + name, ha="center", va="top", fontsize=8)
    axes.set(aspect="equal", ylim=(base * (1 + _FOOT), None))
    axes.margins(0.03, 0.08)
    axes.set_axis_off()
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncol=4, fontsize=8, frameon=False)
    scale_bar(axes, "mm", narrowest=narrowest_mm)


def _draw_rays(axes: Axes, lens: Lens, view: View) -> None:
    """Draw a fan of rays for each field, turned into the plane of the drawing."""
    vertices, field_names = lens.vertices, shown_fields(view)
    radius = view.radii[list(field_names)]
    along_y = view.in_reference().along_y(radius)
    fan = torch.stack([torch.zeros(_RAYS), torch.linspace(-_PUPIL, _PUPIL, _RAYS)], -1).double()
    start = launch_fields(lens, along_y, fan)
    image, surface_rays = trace_full(lens, start, lens.refractive_indices(along_y.wavelengths_um))
    # Rays are drawn from the foremost plane straight to the first refracting surface, since a stop may be behind it.
    z_surfaces = [surface_rays[i].z[:, 0] + vertices[i] for i in lens.refracting_surfaces]
    y_surfaces = [surface_rays[i].y[:, 0] for i in lens.refracting_surfaces]
    front = torch.full_like(z_surfaces[0], float(vertices.min()))
    y_front = y_surfaces[0] - (start.m / start.n)[:, 0] * (z_surfaces[0] - front)
    z = torch.stack([front, *z_surfaces, torch.full_like(front, float(vertices[-1] + lens.thickness[-1]))])
    y = torch.stack([y_front, *y_surfaces, image.y[:, 0]])
    angles = torch.rad2deg(torch.atan(radius / view.efl)).tolist()
    for k, (name, colour) in enumerate(zip(field_names.values(), FIELD_COLOURS, strict=False)):
        valid = image.valid[k, 0]
        lost = int((~valid).sum())
        label = f"{name}, {angles[k]:.2g}°" + (f" ({lost} of {len(valid)} rays lost)" if lost else "")
        axes.plot(z[:, k, valid].numpy(), y[:, k, valid].numpy(), color=colour, lw=0.7)
        axes.plot([], [], color=colour, label=label)
