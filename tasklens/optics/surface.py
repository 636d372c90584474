"""A refracting surface in plain autograd: sag, normal, intersection and refraction."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tasklens.optics import aspheres
from tasklens.optics.rays import GRAZING, RIM, Rays, RayStatus

_STEPS = 400
_CLOSE = 1e-9  # [mm] last step towards a surface; the error after it is of the order of its square
_FAR = 1e7  # [mm] largest r at which a ray meets a surface


@dataclass(frozen=True)
class Surface:
    """An even asphere of revolution about the z axis with its vertex at z = 0; autograd differentiates every method.

    Attributes:
        curvature: c [1/mm], number or 0-dim; positive with the centre on the right, 0 for a plane.
        conic: k, number or 0-dim. k < -1 is a hyperboloid, -1 a paraboloid, -1 < k < 0 a prolate ellipsoid, 0 a sphere,
            k > 0 an oblate ellipsoid.
        alpha: (M,) asphere coefficients alpha_2 .. alpha_2M [mm^(1 - 2j)].
        semi_diameter: radius of the clear aperture [mm], number or 0-dim; infinite if nothing clips.
    """

    curvature: Tensor | float
    conic: Tensor | float = 0.0
    alpha: Tensor | tuple[float, ...] = ()
    semi_diameter: Tensor | float = torch.inf

    def sag(self, x: Tensor, y: Tensor) -> Tensor:
        """Compute the sag z = s(r^2) of the surface at (x, y) [mm].

        s = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + sum_j alpha_2j r^(2j),  r^2 = x^2 + y^2
        """
        return self._profile(x * x + y * y)[0]

    def normal(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the unit normal at (x, y) [mm], with positive z component.

        N = (-ds/dx, -ds/dy, 1) / sqrt(1 + (ds/dx)^2 + (ds/dy)^2),  ds/dx = 2 x ds/d(r^2)
        """
        slope = 2 * self._profile(x * x + y * y)[1]
        n = torch.rsqrt(1 + slope * slope * (x * x + y * y))
        return -slope * x * n, -slope * y * n, n

    def intersect(self, rays: Rays, index: Tensor | float = 1.0) -> Rays:
        """Move rays along P + t D to their intersection with the surface, z = s(x^2 + y^2).

        Newton's iteration computes t without a graph; one more step with a graph makes the derivatives of t exact by
        the implicit function theorem: F(t, p) = 0 has dt/dp = -(dF/dp) / (dF/dt). Second derivatives are not exact.

        Args:
            rays: rays of any shape, z from the vertex [mm].
            index: refractive index in front of the surface, for the optical path; broadcasts with the rays.

        Returns:
            Rays on the surface. A ray that does not meet it from the front gets the status MISSED and stays in place; a
            ray outside the clear aperture gets VIGNETTED and stays on the surface. The status of rays that are already
            lost does not change. The caller sets `lost_at`.
        """
        with torch.no_grad():
            t, hits = self._distance(rays)
        t = t.detach()  # forward mode looks past no_grad
        t = torch.where(hits, t + self._newton_step(rays, t)[0], 0.0)
        x, y, z = rays.x + t * rays.l, rays.y + t * rays.m, rays.z + t * rays.n
        outside = x * x + y * y > self.semi_diameter**2 * (1 + RIM)
        rays = replace(rays, x=x, y=y, z=z, path=rays.path + index * t)
        return _lose(_lose(rays, ~hits, RayStatus.MISSED), outside, RayStatus.VIGNETTED)

    def refract(self, rays: Rays, index_before: Tensor | float, index_behind: Tensor | float) -> Rays:
        """Refract rays on the surface by Snell's law, n sin i = n' sin i'.

        D' = mu D + (cos i' - mu cos i) N,  mu = n / n',  cos i = D.N,  cos^2 i' = 1 - mu^2 (1 - cos^2 i)

        Args:
            rays: rays of any shape, as from `intersect`.
            index_before, index_behind: refractive indices n and n'; they broadcast with the rays.

        Returns:
            The rays behind the surface. If cos^2 i' or the z component of D' is not positive, the status is
            TOTAL_INTERNAL_REFLECTION and the direction is not changed.
        """
        nx, ny, nz = self.normal(rays.x, rays.y)
        mu = index_before / index_behind
        cos_i = rays.l * nx + rays.m * ny + rays.n * nz
        squared = 1 - mu * mu + (mu * cos_i) ** 2
        passes = squared > GRAZING**2
        turn = torch.sqrt(torch.where(passes, squared, 1.0)) - mu * cos_i
        l, m, n = mu * rays.l + turn * nx, mu * rays.m + turn * ny, mu * rays.n + turn * nz
        passes = passes & (n > GRAZING)
        bends = passes & rays.valid
        l, m, n = (torch.where(bends, new, old) for new, old in ((l, rays.l), (m, rays.m), (n, rays.n)))
        return _lose(replace(rays, l=l, m=m, n=n), ~passes, RayStatus.TOTAL_INTERNAL_REFLECTION)

    def _profile(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the sag, its derivative by u = r^2, and whether u is inside the conic."""
        return aspheres.sag(u, self.curvature, self.conic, self._alpha(u))

    def _alpha(self, like: Tensor) -> Tensor:
        return torch.as_tensor(self.alpha, dtype=like.dtype)

    def _newton_step(self, rays: Rays, t: Tensor) -> tuple[Tensor, Tensor]:
        """Compute Newton's step from t for F(t) = z + t n - s(r^2) = 0, and whether the point is on the conic's front.

        dF/dt = n - 2 ds/d(r^2) (x l + y m) is the cosine of incidence times the length of the normal.
        """
        x, y = rays.x + t * rays.l, rays.y + t * rays.m
        sag, slope, inside = self._profile(x * x + y * y)
        derivative = rays.n - 2 * slope * (x * rays.l + y * rays.m)
        safe = torch.copysign(derivative.abs().clamp(min=GRAZING), derivative)
        return (sag - rays.z - t * rays.n) / safe, inside & (derivative > GRAZING)

    def _distance(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Compute the distance t [mm] along each ray to its first crossing, or zero, and which rays have one.

        A ray in front of the surface goes forward, one behind it backward. Steps cannot pass a crossing: with
        |F''| <= B on the next D mm, |F| does not vanish before 2 |F| / (F' + sqrt(F'^2 + 2 B |F|)), where F' is the
        derivative along the ray. Near a crossing this is Newton's step; a ray without one comes to the conic's edge.
        """
        able = rays.valid & (rays.n > GRAZING)
        x, y, z, l, m, n = (torch.where(able, v, k == "n").double() for k, v in vars(rays).items() if k in "xyzlmn")
        squared_sine = l * l + m * m
        bending = float((1 + self.conic) * self.curvature**2)
        end = min((1 - aspheres.EDGE) / bending, _FAR**2) if bending > 0 else _FAR**2

        def along(t: Tensor) -> tuple[Tensor, Tensor]:
            """Return u = r^2 and half its derivative at t."""
            return (x + t * l) ** 2 + (y + t * m) ** 2, x * l + y * m + t * squared_sine

        u, h = along(torch.zeros_like(n))
        root = torch.sqrt((h * h - squared_sine * (u - end)).clamp(min=0))
        inside = u < end
        t = torch.where(inside | (root == 0), 0.0, -(u - end) / (h + torch.copysign(root, h)))  # to the edge
        side = torch.where(z + t * n <= self._profile(along(t)[0])[0], 1.0, -1.0)
        pending = able & (inside | (root > 0)) & (t * side >= 0)
        window, hits = torch.ones_like(n), torch.zeros_like(pending)
        for _ in range(_STEPS):
            u, h = along(t)
            sag, slope, _ = self._profile(u)
            gap = (side * (sag - z - t * n)).clamp(min=0)
            derivative = n - 2 * slope * h
            away, root = side * h, torch.sqrt(h * h + squared_sine * (end - u).clamp(min=0))
            way_out = torch.where(away >= 0, (end - u) / (away + root), (root - away) / squared_sine)
            window = torch.minimum(window, 0.75 * way_out)
            u_window, h_window = along(t + side * window)
            steepest, most = aspheres.bounds(torch.maximum(u, u_window), self.curvature, self.conic, self._alpha(u))
            bound = 4 * most * torch.maximum(h * h, h_window * h_window) + 2 * steepest * squared_sine
            step = 2 * gap / (derivative + torch.sqrt(derivative * derivative + 2 * bound * gap))
            close = (step <= window) & (step <= _CLOSE)
            t = torch.where(pending, t + side * torch.where(close, gap / derivative, torch.minimum(step, window)), t)
            hits = hits | (pending & close & (derivative > GRAZING))
            pending = pending & ~close & (way_out > _CLOSE) & (step >= 0)
            window = 2 * torch.minimum(step, window)
            if not bool(pending.any()):
                break
        return torch.where(hits, t, 0.0).to(rays.n.dtype), hits


def _lose(rays: Rays, lost: Tensor, status: RayStatus) -> Rays:
    """Set the status of valid rays that are `lost`."""
    return replace(rays, status=torch.where(rays.valid & lost, torch.tensor(status, dtype=torch.int8), rays.status))
