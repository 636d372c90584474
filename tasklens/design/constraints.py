"""Limits of designs and their margins; a negative margin is a violation.

A new limit has a key in `settings.specification`, its margin here, its derivative in `linear_limits` in the same order,
and, if it scales with the lens, its name in `from_lens`.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import launch_fields
from tasklens.optics.analysis.spots import OUTLINE, chief_rays, clear_semi_diameters, distortion
from tasklens.optics.aspheres import radial_slope, sag
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.tracing.trace import trace
from tasklens.optics.view import View
from tasklens.settings.specification import Constraints

HEIGHTS = torch.linspace(0, 1, 17, dtype=torch.float64)  # fractions of the semi-diameter at which limits are checked
_INCIDENT = OUTLINE[::8]  # (N, 2) pupil points of the rays whose incidence is penalised; the last is the chief ray
BUFFER = 0.01  # margin that designs aim at: soft penalties end short of it [mm; a tenth for fractions and angles]


def manufacturing_margins(lens: Lens, limits: Constraints, semi_diameter: Tensor) -> dict[str, Tensor]:
    """Compute the margins of manufacturing limits [mm; slopes without unit], negative where a limit is violated.

    An element has the larger of the illuminated radii on its two surfaces. Beyond the illuminated radius, a
    surface is a flat flange, and its polynomial is not evaluated.

    Args:
        semi_diameter: (S,) illuminated radius on each surface [mm].
    """
    semi = semi_diameter.clamp(min=float(lens.semi_diameter[lens.stop]))
    front, behind, element = spaces(lens)
    shared = torch.maximum(semi[front], semi[behind])[:, None] * HEIGHTS

    def surface_sag(surfaces: Tensor | list[int], heights: Tensor) -> Tensor:
        squares = torch.minimum(heights, semi[surfaces, None]) ** 2
        return sag(squares, lens.curvature[surfaces, None], lens.conic[surfaces, None], lens.alpha[surfaces, None])[0]

    distance = lens.vertices[behind] - lens.vertices[front]
    gap = distance[:, None] + surface_sag(behind, shared) - surface_sag(front, shared)
    centre, edge = distance[element], gap[element]
    last = lens.refracting_surfaces[-1]  # planes in air may follow
    last_sag = surface_sag([last], semi[[last], None] * HEIGHTS)
    slope = radial_slope(semi[:, None] * HEIGHTS, lens.curvature[:, None], lens.conic[:, None], lens.alpha[:, None])
    return {
        "min_centre_thickness": centre - limits.min_centre_thickness,
        "max_centre_thickness": limits.max_centre_thickness - centre,
        "min_edge_thickness": (edge - limits.min_edge_thickness).flatten(),
        "min_air_gap": (gap[~element] - limits.min_air_gap).flatten(),
        "min_back_focus": (lens.thickness[last:].sum() - last_sag - limits.min_back_focus).flatten(),
        "max_track": limits.max_track - lens.thickness.sum()[None],
        "max_slope": (limits.max_slope - slope.abs()).flatten(),
    }


def spaces(lens: Lens) -> tuple[Tensor, Tensor, Tensor]:
    """Return the surfaces (P,) in front of and behind each space between elements, and which spaces (P,) are elements.

    A plane in air between elements, or a stop inside the first element, bounds no space; a stop in front of the lens
    does.
    """
    refracting = lens.refracting_surfaces
    pairs = list(pairwise(refracting))
    vertices = lens.vertices.detach()
    if lens.stop < refracting[0] and float(vertices[refracting[0]] - vertices[lens.stop]) >= 0:
        pairs.insert(0, (lens.stop, refracting[0]))
    front, behind = torch.tensor(pairs).unbind(-1)
    return front, behind, torch.tensor([lens.media[i] != AIR for i, _ in pairs])


def first_order_margins(lens: Lens, limits: Constraints, view: View, chief: Rays) -> dict[str, Tensor]:
    """Compute the margins of focal length and distortion, as fractions, and of the chief ray angle [rad].

    Args:
        chief: (F, 1, 1) chief rays of `view` on the image plane.
    """
    off_axis = view.radii > 0
    points = torch.stack([chief.x, chief.y], -1)[:, 0, 0]
    power = view.efl * paraxial(lens, view.reference_um).power
    ideal = view.fields * image_scale(lens, view)
    margins = {
        "efl_tolerance": limits.efl_tolerance - (power[None] - 1).abs(),
        "distortion": limits.distortion - distortion(ideal, points)[off_axis].abs(),
    }
    if limits.max_chief_ray_angle_deg is not None:
        l, m, n = (v[off_axis, 0, 0] for v in (chief.l, chief.m, chief.n))
        margins["chief_ray_angle"] = math.radians(limits.max_chief_ray_angle_deg) - torch.atan2(torch.hypot(l, m), n)
    return margins


def all_margins(
    lens: Lens, limits: Constraints, view: View, semi_diameter: Tensor, chief: Rays | None = None
) -> dict[str, Tensor]:
    """Compute the margins of all limits at clear apertures `semi_diameter` (S,) [mm]; `chief` defaults to a trace."""
    chief = chief_rays(lens, view) if chief is None else chief
    return manufacturing_margins(lens, limits, semi_diameter) | first_order_margins(lens, limits, view, chief)


def violation(margins: Mapping[str, Tensor]) -> Tensor:
    """Return the violation of all limits, with a buffer, as one vector; zero if a margin exceeds the buffer."""
    return torch.cat([(BUFFER * buffer_scale(name) - margin).clamp(min=0) for name, margin in margins.items()])


def buffer_scale(name: str) -> float:
    """Return the factor on the buffer of a limit: fractions and angles have a tenth of it."""
    return 0.1 if name in ("efl_tolerance", "distortion", "chief_ray_angle") else 1.0


def limit_margins(lens: Lens, limits: Constraints, view: View, semi_diameter: Tensor) -> dict[str, Tensor]:
    """Compute the margins of all limits at all radii of the sensor, at clear apertures `semi_diameter` (S,) [mm]."""
    return all_margins(lens, limits, view.at_all_radii(), semi_diameter)


def penalty(lens: Lens, limits: Constraints, view: View) -> Tensor:
    """Sum the squared violations of all limits, for gradient descent."""
    axis_and_corner = torch.stack([torch.zeros_like(view.fields[0]), view.fields[view.radii.argmax()]])
    semi_diameter = clear_semi_diameters(lens.detached(), replace(view.in_reference(), fields=axis_and_corner))
    return violation(limit_margins(lens, limits, view, semi_diameter)).square().sum()


def incidence_penalty(lens: Lens, view: View, largest_deg: float) -> Tensor:
    """Sum over surfaces the mean squared excess of angles of incidence over a limit [rad^2] (paper, 3.3).

    A surface turns a ray by n' D' - n D = (n' cos i' - n cos i) N, along its normal N. So

    cos i = |D . (n' D' - n D)| / |n' D' - n D|

    The rays are the marginal and chief rays of the middle wavelength at all fields.
    """
    indices = lens.refractive_indices((view.reference_um,))
    rays = launch_fields(lens, view, _INCIDENT, (view.reference_um,))
    total, direction = torch.zeros((), dtype=lens.dtype), torch.stack([rays.l, rays.m, rays.n])
    for i in lens.refracting_surfaces:
        shape = {name: getattr(lens, name)[: i + 1] for name in ("curvature", "conic", "alpha", "thickness", "media")}
        front = replace(lens, stop=min(lens.stop, i), semi_diameter=lens.semi_diameter[: i + 1], **shape)
        next_rays = trace(front, rays, indices[: i + 2])
        next_direction = torch.stack([next_rays.l, next_rays.m, next_rays.n])
        refraction = indices[i + 1] * next_direction - indices[i] * direction
        squared = refraction.square().sum(0)
        cosine = (direction * refraction).sum(0).abs() * torch.rsqrt(squared.clamp(min=1e-18))
        steep = next_rays.valid & (cosine < math.cos(math.radians(largest_deg)))
        excess = torch.acos(torch.where(steep, cosine, 0.5)) - math.radians(largest_deg)
        total = total + torch.where(steep, excess, 0.0).square().mean()
        direction = next_direction
    return total


def smallest_margins(margins: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the smallest margin of each limit, in the unit of the limit: the chief ray angle in degrees."""
    smallest = {name: float(margin.min()) for name, margin in margins.items() if margin.numel()}
    if "chief_ray_angle" in smallest:
        smallest["chief_ray_angle"] = math.degrees(smallest["chief_ray_angle"])
    return smallest


def worst_margin(margins: Mapping[str, Tensor]) -> tuple[str, float]:
    """Return name and value of the smallest margin."""
    smallest = smallest_margins(margins)
    name = min(smallest, key=lambda key: smallest[key] if math.isfinite(smallest[key]) else -math.inf)
    return name, smallest[name]
