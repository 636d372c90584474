"""A lens as HTML, for notebooks: its cross-section and its prescription."""

import html as markup
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from tasklens.materials.material import AIR, Material, short_name
from tasklens.optics.aspheres import sag
from tasklens.optics.surface import Surface

_WIDTH, _MARGIN = 420, 8  # width and margin of the drawing [pixels]
_UNLIMITED = 1.5  # height of a surface without clear aperture, relative to the largest clear aperture
_STEEPEST = 0.98  # largest height on a sphere, relative to its radius


def html(surfaces: Sequence[Surface], thickness: Tensor, media: Sequence[Material], stop: int) -> str:
    """Return the cross-section of a lens as SVG, and a table of radii, distances, media and clear apertures [mm].

    Args:
        surfaces: S surfaces, without graph.
        thickness: (S,) distances to the next surface, the last to the image plane [mm].
        media: S materials behind the surfaces.
        stop: index of the stop.
    """
    cells = ("surface", "radius", "thickness", "material", "conic", "semi-diameter", "")
    rows = [f"<tr>{''.join(f'<th>{cell}</th>' for cell in cells)}</tr>"]
    for i, (surface, medium) in enumerate(zip(surfaces, media, strict=True)):
        values = (
            str(i),
            f"{1 / float(surface.curvature):.5g}" if surface.curvature else "plane",
            f"{float(thickness[i]):.5g}",
            markup.escape(short_name(medium)) if medium != AIR else "",
            f"{float(surface.conic):.4g}" if surface.conic else "",
            f"{float(surface.semi_diameter):.4g}" if math.isfinite(surface.semi_diameter) else "",
            ", ".join(["stop"] * (i == stop) + ["asphere"] * bool(torch.as_tensor(surface.alpha).any())),
        )
        rows.append(f"<tr>{''.join(f'<td>{value}</td>' for value in values)}</tr>")
    return f"{_drawing(surfaces, thickness, media, stop)}<table>{''.join(rows)}</table>"


def _drawing(surfaces: Sequence[Surface], thickness: Tensor, media: Sequence[Material], stop: int) -> str:
    """Draw the elements, the stop and the image plane."""
    *vertices, image = [0.0, *thickness.cumsum(0).tolist()]
    finite = [float(surface.semi_diameter) for surface in surfaces if math.isfinite(surface.semi_diameter)]
    unlimited = _UNLIMITED * max(finite, default=1.0)
    outlines = [_outline(surface, vertex, unlimited) for surface, vertex in zip(surfaces, vertices, strict=True)]
    half = max(float(height[-1]) for _, height in outlines)
    left = min(0.0, *(float(z.min()) for z, _ in outlines))
    right = max(image, *(float(z.max()) for z, _ in outlines))
    scale = (_WIDTH - 2 * _MARGIN) / max(right - left, 1e-9)

    def path(points: Sequence[tuple[float, float]], style: str, closed: bool = False) -> str:
        at = (f"{_MARGIN + scale * (z - left):.1f},{_MARGIN + scale * (half - y):.1f}" for z, y in points)
        return f'<path d="M{" L".join(at)}{" Z" if closed else ""}" {style}/>'

    parts = []
    for i, medium in enumerate(media[:-1]):
        if medium != AIR:
            (z0, y0), (z1, y1) = outlines[i], outlines[i + 1]
            z, y = torch.cat([z0, z1.flip(0)]), torch.cat([y0, y1.flip(0)])
            points = list(zip(z.tolist(), y.tolist(), strict=True))
            parts.append(path(points, 'fill="#DCE6F0" stroke="black"', closed=True))
    radius = min(float(surfaces[stop].semi_diameter), half)
    for sign in (1, -1):
        rim = [(vertices[stop], sign * radius), (vertices[stop], sign * 1.2 * radius)]
        parts.append(path(rim, 'stroke="black" stroke-width="3"'))
    parts.append(path([(image, -half), (image, half)], 'stroke="black"'))
    height = 2 * _MARGIN + 2 * scale * half
    return f'<svg width="{_WIDTH}" height="{height:.0f}" fill="none">{"".join(parts)}</svg>'


def _outline(surface: Surface, vertex: float, unlimited: float) -> tuple[Tensor, Tensor]:
    """Return z and height of a surface up to its clear aperture, or up to `unlimited` if it has none."""
    half = min(float(surface.semi_diameter), unlimited)
    bend = (1 + float(surface.conic)) * float(surface.curvature) ** 2
    if bend > 0:
        half = min(half, _STEEPEST / math.sqrt(bend))
    height = torch.linspace(-1, 1, 41, dtype=torch.float64) * half
    return vertex + sag(height**2, surface.curvature, surface.conic, torch.as_tensor(surface.alpha))[0], height
