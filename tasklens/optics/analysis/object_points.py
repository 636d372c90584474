"""Object points of fields, at infinity or at a finite distance: rays from them, and their paraxial images.

With the vergence v = 1 / distance of the object from the first vertex, a field of direction tangents T is the object
point that lies in the direction T from the centre of the paraxial entrance pupil, at z: (x, y) = -T (z + 1 / v). A ray
from it that meets the first vertex plane at the point p has the slope

    (l / n, m / n) = t + v p,   t = T (1 + z v)

with the tangents t of the field as seen from the first vertex. v = 0 is an object at infinity, where all slopes are T.
The object point follows the entrance pupil when the lens changes, in derivatives too.
"""

import torch
from torch import Tensor

from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray, powers_and_thicknesses
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, launch
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError


def vertex_tangents(lens: Lens, view: View) -> Tensor:
    """Compute the direction tangents (F, 2) of the fields as seen from the first vertex.

    Raises:
        InputError: the object is in the entrance pupil, or the entrance pupil is at infinity.
    """
    tangents = view.tangents.to(lens.dtype)
    if not view.object_vergence:
        return tangents
    from_pupil = 1 + paraxial(lens, view.reference_um).entrance_pupil_z * view.object_vergence
    tangents = tangents * from_pupil
    if not 0 < abs(float(from_pupil.detach())) < torch.inf:
        raise InputError(
            f"object at {view.object_distance:g} mm: fields have no angle there, since the entrance pupil lies in the "
            "object or at infinity; choose another distance"
        )
    return tangents


def rays_from_object(point: Tensor, tangents: Tensor, vergence: float) -> Rays:
    """Launch rays at points (..., 2) [mm] of the first vertex plane.

    Args:
        tangents: (..., 2) direction tangents of the object points as seen from the first vertex.
        vergence: 1 / distance of the object from the first vertex [1/mm].
    """
    slope = tangents + vergence * point if vergence else tangents
    n = torch.rsqrt(1 + slope.square().sum(-1))
    sx, sy = slope.unbind(-1)
    x, y = point.unbind(-1)
    return launch(x, y, torch.zeros_like(n), sx * n, sy * n, n)


def check_in_front(lens: Lens, view: View, rays: Rays) -> None:
    """Check that object points are in front of the first lens surface; the object may be inside a hollow surface.

    The surface extends to its clear aperture; without one, to the outermost of the launched rays.

    Raises:
        InputError: an object point is not in front of the lens.
    """
    first = next(iter(lens.refracting_surfaces), 0)
    surface = lens.surfaces[first]
    rim = float(surface.semi_diameter)
    if rim == torch.inf:
        rim = float(torch.hypot(rays.x, rays.y).detach().max())
    height = (view.object_distance * vertex_tangents(lens, view).detach().norm(dim=-1)).clamp(max=rim)
    foremost = float((lens.vertices[first] + surface.sag(torch.zeros_like(height), height)).detach().min())
    if -view.object_distance >= foremost:
        raise InputError(
            f"object at {view.object_distance:g} mm from the first vertex: the first lens surface reaches "
            f"{-foremost:.4g} mm in front of it; expected a larger distance"
        )


def object_path(lens: Lens, view: View, rays: Rays) -> Tensor:
    """Compute the distance (F, W, N) of launched rays from their object point, minus that of the first vertex [mm].

    With the launch point p, the direction E of the ray through the first vertex, and c = 1 / its distance from the
    object point, it is a sum without cancellation; at c = 0 it is the path of a plane wave, p.E:

        (2 p.E + c p.p) / (1 + sqrt(1 + 2 c p.E + c^2 p.p))
    """
    tangents = vertex_tangents(lens, view)[:, None, None]
    n = torch.rsqrt(1 + tangents.square().sum(-1))
    tx, ty = tangents.unbind(-1)
    curvature = view.object_vergence * n
    along, square = rays.x * (tx * n) + rays.y * (ty * n), rays.x.square() + rays.y.square()
    root = torch.sqrt(1 + curvature * (2 * along + curvature * square))
    return (2 * along + curvature * square) / (1 + root)


def image_scale(lens: Lens, view: View) -> Tensor:
    """Compute the ratio k of a paraxial image height, k f T, to that for an object at infinity, f T.

    k = (1 + z v) phi / a,  a the reduced angle -n' u' behind the lens of the paraxial ray from the axial object point
    to a height of 1 on the first vertex plane, and the power phi the same angle for an object at infinity. k is also
    the ratio of the F-numbers.

    Raises:
        InputError: the lens forms no real image of the object.
    """
    if not view.object_vergence:
        return torch.ones((), dtype=lens.dtype)
    first_order = paraxial(lens, view.reference_um)
    return (1 + first_order.entrance_pupil_z * view.object_vergence) * first_order.power / _convergence(lens, view)


def magnification(lens: Lens, view: View) -> float:
    """Compute the paraxial lateral magnification of an object at a finite distance, negative for an inverted image.

    Raises:
        InputError: the lens forms no real image of the object.
    """
    return -view.object_vergence / float(_convergence(lens, view).detach())


def _convergence(lens: Lens, view: View) -> Tensor:
    """Compute -n' u' of the paraxial ray from the axial object point to a height of 1 [1/mm]; raises InputError."""
    index = lens.refractive_indices((view.reference_um,))[:, 0]
    one = torch.ones((), dtype=lens.dtype)
    heights, angles = paraxial_ray(*powers_and_thicknesses(lens, index), one, index[0] * view.object_vergence * one)
    if not float((heights[-1] / angles[-1]).detach()) < 0:
        raise InputError(f"object at {view.object_distance:g} mm: the lens forms no real image of it; move it away")
    return -angles[-1]
