"""Third-order aberrations by surface, and field curvature along the real chief rays.

Sign conventions: a single positive lens has S_I, S_IV and C_I > 0 (undercorrected); S_V > 0 is a barrel. Third-order
terms refer to the paraxial image plane and to the largest field of the view, rotated onto +y.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tasklens.optics.analysis.paraxial import paraxial, paraxial_ray, powers_and_thicknesses, vertex_curvature
from tasklens.optics.analysis.spots import chief_rays_full
from tasklens.optics.aspheres import sag
from tasklens.optics.lens import Lens
from tasklens.optics.view import View


def seidel_sums(lens: Lens, view: View) -> dict[str, Tensor]:
    """Compute the Seidel sums at the middle wavelength, and the colour between the shortest and the longest.

    With the marginal ray (y, u), the chief ray (yb, ub), A = n (c y + u), B = n (c yb + ub), H = B y - A yb, D() the
    change across the surface, and the vertex curvature c = curvature + 2 alpha_2:

        S_I = -A^2 y D(u / n) + a y^4,   S_II = -A B y D(u / n) + a y^3 yb,   S_III = -B^2 y D(u / n) + a y^2 yb^2
        S_IV = -H^2 c D(1 / n),   S_V = -B (B^2 y D(1 / n^2) - (H + B y) yb c D(1 / n)) + a y yb^3
        C_I = A y D(dn / n),   C_II = B y D(dn / n)

    a = D(n) (8 alpha_4 + (1 + k) curvature^3 - c^3) is 8 D(n) times the r^4 term of the surface minus that of the
    sphere that osculates its vertex. With alpha_2 the curvature of this sphere is not `curvature`.

    The wavefront aberration at the edge of the field is, with p^2 = px^2 + py^2, 1 at the edge of the pupil,

        W(px, py) = S_I p^4 / 8 + S_II p^2 py / 2 + S_III py^2 / 2 + (S_III + S_IV) p^2 / 4 + S_V py / 2

    The wavefront at the shortest wavelength minus that at the longest is C_I p^2 / 2 + C_II py. A ray misses its
    paraxial image point by (dW / dpx, dW / dpy) / (n' u'), n' u' the last reduced angle of the marginal ray.

    Returns:
        The contributions (S,) of the surfaces [mm]: `spherical`, `coma`, `astigmatism`, `petzval`, `distortion` are
        S_I .. S_V; `axial_colour`, `lateral_colour` are C_I, C_II.

    Source: Welford, Aberrations of Optical Systems (1986), chapters 8 and 10.
    """
    wavelengths = (view.reference_um, min(view.wavelengths_um), max(view.wavelengths_um))
    n, shortest, longest = lens.refractive_indices(wavelengths).unbind(-1)
    dispersion = (shortest - longest) / n
    first_order = paraxial(lens, view.reference_um)
    tangent = view.tangents.norm(dim=-1).max()
    z, vergence = first_order.entrance_pupil_z, view.object_vergence
    height = torch.stack([first_order.entrance_pupil_radius / (1 + z * vergence), -tangent * z])
    angle = torch.stack([vergence * height[0], tangent]) * n[0]
    heights, angles = paraxial_ray(*powers_and_thicknesses(lens, n), height, angle)
    (y, yb), (nu, nub) = heights.unbind(-1), angles[:-1].unbind(-1)
    c = vertex_curvature(lens)
    a, b = n[:-1] * c * y + nu, n[:-1] * c * yb + nub
    invariant = b * y - a * yb

    bend = (angles[:, 0] / n**2).diff()
    petzval, square = (1 / n).diff(), (1 / n**2).diff()
    fourth = lens.alpha[:, 1] if lens.alpha.shape[1] > 1 else torch.zeros_like(c)
    aspheric = n.diff() * (8 * fourth + (1 + lens.conic) * lens.curvature**3 - c**3)
    return {
        "spherical": -(a**2) * y * bend + aspheric * y**4,
        "coma": -a * b * y * bend + aspheric * y**3 * yb,
        "astigmatism": -(b**2) * y * bend + aspheric * y**2 * yb**2,
        "petzval": -(invariant**2) * c * petzval,
        "distortion": -b * (b**2 * y * square - (invariant + b * y) * yb * c * petzval) + aspheric * y * yb**3,
        "axial_colour": a * y * dispersion.diff(),
        "lateral_colour": b * y * dispersion.diff(),
    }


def field_curvature(lens: Lens, view: View) -> tuple[Tensor, Tensor]:
    """Compute the tangential and sagittal focus of rays near each chief ray, at the middle wavelength.

    Coddington's equations along the real chief ray, for the distance h of a neighbour from it and its angle w:

        tangential: h' = h cos(i') / cos(i),   n' w' = n w cos(i) / cos(i') - h c_t K / (cos(i) cos(i'))
        sagittal:   h' = h,                    n' w' = n w - h c_s K,           K = n' cos(i') - n cos(i)

    h becomes h + w D over the distance D to the next surface. The initial values are h = 1 on the first vertex plane
    and w = 1 / distance from the object point. c_t = s'' / (1 + s'^2)^(3/2) and c_s = s' / (r sqrt(1 + s'^2)) are the
    curvatures of the surface in and across the meridian at its intersection with the chief ray. Differentiable once in
    the lens: a trace without graph computes the intersections, then the chief ray is followed through them with a
    graph, from its launch point, which moves with the lens.

    Returns:
        (F,) and (F,) distances from the image plane to the focus, along z [mm]; negative in front of it, infinite for
        parallel neighbours, NaN if the chief ray is lost.

    Source: Coddington 1829; Welford, Aberrations of Optical Systems (1986), chapter 9.
    """
    lens = replace(lens, pose=None)
    start, image, rays_behind = chief_rays_full(lens, view.in_meridian())
    arrives = image.valid[:, 0, 0]
    index = lens.refractive_indices((view.reference_um,))[:, 0]
    y, z, m, n = (values[arrives, 0, 0] for values in (start.y, start.z, start.m, start.n))
    tangential = sagittal = (torch.ones_like(n), view.object_vergence * n)
    for i, rays in enumerate(rays_behind):
        distance = _distance(lens, i, rays.y[arrives, 0, 0], (y, z, m, n))
        y, z = y + distance * m, z + distance * n
        along, across, cosine = _local_curvatures(lens, i, y)
        cos_before = (n - m * across * y) * cosine
        cos_behind = torch.sqrt(1 - (index[i] / index[i + 1]) ** 2 * (1 - cos_before.square()))
        strength = index[i + 1] * cos_behind - index[i] * cos_before
        h, w = _move(tangential, distance)
        w = (index[i] * w * cos_before / cos_behind - h * along * strength / (cos_before * cos_behind)) / index[i + 1]
        tangential = (h * cos_behind / cos_before, w)
        h, w = _move(sagittal, distance)
        sagittal = (h, (index[i] * w - h * across * cosine * strength) / index[i + 1])
        # Snell's law as vectors: n' D' = n D + K N, with the normal N = (-s', 1) / sqrt(1 + s'^2)
        m = (index[i] * m - strength * across * y * cosine) / index[i + 1]
        n = (index[i] * n + strength * cosine) / index[i + 1]
        z = z - lens.thickness[i]

    def focus(ray: tuple[Tensor, Tensor]) -> Tensor:
        h, w = _move(ray, -z / n)
        distances = torch.full(arrives.shape, torch.nan, dtype=lens.dtype)
        return distances.masked_scatter(arrives, -h / w * n)

    return focus(tangential), focus(sagittal)


def _distance(lens: Lens, surface: int, height: Tensor, ray: tuple[Tensor, ...]) -> Tensor:
    """Compute the distance along a ray (y, z, m, n) to the surface, which it meets at `height` [mm].

    The ray meets the tangent at this point, s + s' (y - height), in the same point. To first order this also holds for
    a changed ray or surface.
    """
    y, z, m, n = ray
    s, slope, _ = sag(height * height, lens.curvature[surface], lens.conic[surface], lens.alpha[surface])
    steepness = 2 * height * slope
    return (s + steepness * (y - height) - z) / (n - steepness * m)


def _move(ray: tuple[Tensor, Tensor], distance: Tensor) -> tuple[Tensor, Tensor]:
    h, w = ray
    return h + w * distance, w


def _local_curvatures(lens: Lens, surface: int, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute c_t [1/mm], s'(r) / r [1/mm], and 1 / sqrt(1 + s'^2) of a surface at heights y [mm]."""
    shape = lens.curvature[surface], lens.conic[surface], lens.alpha[surface]
    u = y * y
    slope, change = torch.func.jvp(lambda u: sag(u, *shape)[1], (u,), (torch.ones_like(u),))  # type: ignore[misc]  # ds/du, d2s/du2
    across = 2 * slope
    cosine = torch.rsqrt(1 + u * across**2)
    return (across + 4 * u * change) * cosine**3, across, cosine
