"""A lens: surfaces, distances, media and poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from tasklens.materials.material import AIR, Material
from tasklens.optics.lens_html import html
from tasklens.optics.rays import Rays
from tasklens.optics.surface import Surface


@dataclass(frozen=True)
class Pose:
    """Poses of S surfaces: a point P' in the axes of a surface is at P = R P' + p relative to its nominal vertex.

    Attributes:
        rotation: (S, 3, 3) R, whose columns are the axes of the surface.
        position: (S, 3) p, from the nominal vertex to that of the surface [mm].
    """

    rotation: Tensor
    position: Tensor

    @classmethod
    def nominal(cls, surfaces: int, dtype: torch.dtype) -> "Pose":
        """Return the poses of surfaces that are neither decentred nor tilted."""
        return cls(torch.eye(3, dtype=dtype).expand(surfaces, 3, 3), torch.zeros(surfaces, 3, dtype=dtype))

    def moved(self, surfaces: list[int], decentre: Tensor, tilt: Tensor, pivots: Tensor) -> "Pose":
        """Move surfaces as one rigid body: turn them about a pivot, then shift them.

        P -> pivot + (dx, dy, 0) + M (P - pivot),  M = Rx(tilt_x) Ry(tilt_y), right-handed

        Args:
            decentre: (2,) dx, dy [mm].
            tilt: (2,) angles about x and y [rad].
            pivots: (len(surfaces), 3) the pivot from the nominal vertex of each surface [mm].
        """
        turn = _about_x(tilt[0]) @ _about_y(tilt[1])
        shift = torch.cat([decentre, torch.zeros_like(decentre[:1])])
        index = torch.tensor(surfaces)
        position = pivots + shift + (self.position[index] - pivots) @ turn.T
        rotation = turn @ self.rotation[index]
        return Pose(self.rotation.index_copy(0, index, rotation), self.position.index_copy(0, index, position))

    def to_surface(self, i: int, rays: Rays) -> Rays:
        """Transform rays from the axes of the lens, at the nominal vertex i, to the axes of the surface."""
        point = torch.stack([rays.x, rays.y, rays.z], -1) - self.position[i]
        return _with(rays, point @ self.rotation[i], torch.stack([rays.l, rays.m, rays.n], -1) @ self.rotation[i])

    def to_lens(self, i: int, rays: Rays) -> Rays:
        """Transform rays from the axes of surface i to the axes of the lens, at the nominal vertex."""
        turn = self.rotation[i].T
        point = torch.stack([rays.x, rays.y, rays.z], -1) @ turn + self.position[i]
        return _with(rays, point, torch.stack([rays.l, rays.m, rays.n], -1) @ turn)


@dataclass(frozen=True)
class Melt:
    """Difference of the media of a built lens from their catalogues: n + shift + spread (n - n(reference_um)).

    Attributes:
        shift: (S,) change of the index of the medium behind each surface, at `reference_um`.
        spread: (S,) relative change of its dispersion.
        reference_um: wavelength of `shift`.
    """

    shift: Tensor
    spread: Tensor
    reference_um: float


@dataclass(frozen=True)
class Lens:
    """A rotationally symmetric sequential lens of S surfaces with even aspheres; the stop is one of them.

    Attributes:
        curvature: (S,) curvatures [1/mm].
        conic: (S,) conic constants.
        alpha: (S, M) asphere coefficients alpha_2 .. alpha_2M [mm^(1 - 2j)].
        thickness: (S,) axial distance to the next surface, the last to the image plane [mm].
        semi_diameter: (S,) radius of the clear aperture [mm]; infinite if nothing clips.
        media: S materials, the medium behind each surface.
        stop: index of the stop; its semi-diameter is the radius of the stop.
        pose: poses of the surfaces; None: all are nominal. Ray tracing uses it; first-order data, the entrance pupil
            and analyses that turn a field into the meridian use the nominal lens.
        melt: difference of the media from their catalogues; None: no difference.
    """

    curvature: Tensor
    conic: Tensor
    alpha: Tensor
    thickness: Tensor
    semi_diameter: Tensor
    media: tuple[Material, ...]
    stop: int
    pose: Pose | None = None
    melt: Melt | None = None

    def __post_init__(self) -> None:
        surfaces = len(self.media)
        for name in ("curvature", "conic", "thickness", "semi_diameter"):
            if getattr(self, name).shape != (surfaces,):
                raise ValueError(f"{name}: expected shape ({surfaces},), got {tuple(getattr(self, name).shape)}")
        if self.alpha.dim() != 2 or self.alpha.shape[0] != surfaces:
            raise ValueError(f"alpha: expected shape ({surfaces}, M), got {tuple(self.alpha.shape)}")
        if not 0 <= self.stop < surfaces:
            raise ValueError(f"stop: expected a surface 0 .. {surfaces - 1}, got {self.stop}")

    @property
    def dtype(self) -> torch.dtype:
        """Data type of all tensors."""
        return self.curvature.dtype

    @property
    def refracting_surfaces(self) -> tuple[int, ...]:
        """Indices of the surfaces where the medium changes: the surfaces that bound elements."""
        before = (AIR, *self.media[:-1])
        return tuple(i for i, (a, b) in enumerate(zip(before, self.media, strict=True)) if a != b)

    @property
    def surfaces(self) -> list[Surface]:
        """The S surfaces as `Surface`, differentiable in the lens."""
        numbers = (self.curvature, self.conic, self.alpha, self.semi_diameter)
        return [Surface(*surface) for surface in zip(*(v.unbind() for v in numbers), strict=True)]

    @property
    def vertices(self) -> Tensor:
        """(S,) z of each vertex, measured from the first surface [mm]."""
        return torch.cumsum(self.thickness, 0) - self.thickness

    @property
    def not_finite(self) -> str | None:
        """Name of an attribute with a number that is not finite, except clear apertures; None if there is none."""
        names = ("curvature", "conic", "alpha", "thickness")
        bad = [name for name in names if not bool(getattr(self, name).isfinite().all())]
        return bad[0] if bad else "semi_diameter" if bool(self.semi_diameter.isnan().any()) else None

    def refractive_indices(self, wavelengths: tuple[float, ...]) -> Tensor:
        """Return (S + 1, W) refractive indices before the lens and behind each surface, at W wavelengths [um].

        Raises:
            InputError: a medium has no valid index at a wavelength (`Material.refractive_index`).
        """
        indices = torch.tensor(_indices(self.media, wavelengths), dtype=self.dtype)
        if self.melt is None:
            return indices
        at_reference = torch.tensor(_indices(self.media, (self.melt.reference_um,)), dtype=self.dtype)
        shift, spread = (torch.cat([v.new_zeros(1), v])[:, None] for v in (self.melt.shift, self.melt.spread))
        return indices + shift + spread * (indices - at_reference)

    def with_stop_radius(self, radius: float) -> "Lens":
        """Return the lens with another radius of its stop [mm], a constant without gradient."""
        semi_diameter = self.semi_diameter.clone()
        semi_diameter[self.stop] = radius
        return replace(self, semi_diameter=semi_diameter)

    def with_stop_scaled(self, scale: float) -> "Lens":
        """Return the lens with the radius of its stop multiplied by `scale`, differentiable in the radius."""
        factor = torch.ones_like(self.semi_diameter)
        factor[self.stop] = scale
        return replace(self, semi_diameter=self.semi_diameter * factor)

    def with_open_apertures(self) -> "Lens":
        """Return the lens without clear apertures except the stop."""
        semi_diameter = torch.full_like(self.semi_diameter, torch.inf)
        semi_diameter[self.stop] = self.semi_diameter[self.stop]
        return replace(self, semi_diameter=semi_diameter)

    def with_clear_apertures(self, clear: Tensor) -> "Lens":
        """Return the lens with clear apertures of semi-diameters `clear` (S,) [mm] on surfaces that have none.

        They vignette stray rays: task-driven lenses have strongly curved rims, where a few rim rays have large errors.
        """
        return replace(self, semi_diameter=torch.where(self.semi_diameter.isinf(), clear, self.semi_diameter))

    def scaled(self, factor: float) -> "Lens":
        """Return the lens scaled by s: lengths times s, curvatures / s, alpha_2j / s^(2j - 1)."""
        power = 2 * torch.arange(self.alpha.shape[1], dtype=self.dtype) + 1
        return replace(
            self,
            curvature=self.curvature / factor,
            alpha=self.alpha / factor**power,
            thickness=self.thickness * factor,
            semi_diameter=self.semi_diameter * factor,
            pose=self.pose and replace(self.pose, position=self.pose.position * factor),
        )

    def with_surface_moved(self, surface: int, decentre: Tensor, tilt: Tensor) -> "Lens":
        """Return the lens with a surface shifted by `decentre` (2,) [mm] and turned by `tilt` (2,) [rad].

        It turns about its vertex by R = Rx(tilt_x) Ry(tilt_y), right-handed; other surfaces do not move.
        """
        pose = self.pose or Pose.nominal(len(self.media), self.dtype)
        return replace(self, pose=pose.moved([surface], decentre, tilt, pose.position[[surface]]))

    def with_element_moved(self, first: int, last: int, decentre: Tensor, tilt: Tensor) -> "Lens":
        """Return the lens with the surfaces first .. last moved as one body about the nominal vertex of the first.

        Args:
            decentre: (2,) shift along x and y [mm].
            tilt: (2,) right-handed turns about x and y [rad], Rx(tilt_x) Ry(tilt_y).
        """
        pose = self.pose or Pose.nominal(len(self.media), self.dtype)
        surfaces = list(range(first, last + 1))
        along = self.vertices[first] - self.vertices[surfaces]
        pivots = torch.stack([torch.zeros_like(along), torch.zeros_like(along), along], -1)
        return replace(self, pose=pose.moved(surfaces, decentre, tilt, pivots))

    def double(self) -> "Lens":
        """Return the lens in double precision, differentiable in the lens."""
        return self._mapped(Tensor.double)

    def detached(self) -> "Lens":
        """Return the lens detached from autograd."""
        return self._mapped(Tensor.detach)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> "Lens":
        tensors: dict[str, Any] = {k: change(v) for k, v in vars(self).items() if isinstance(v, Tensor)}
        pose = self.pose and Pose(change(self.pose.rotation), change(self.pose.position))
        melt = self.melt and replace(self.melt, shift=change(self.melt.shift), spread=change(self.melt.spread))
        return replace(self, **tensors, pose=pose, melt=melt)

    def _repr_html_(self) -> str:
        """Show the lens in a notebook: its cross-section and its prescription."""
        lens = self.detached()
        return html(lens.surfaces, lens.thickness, lens.media, lens.stop)


@lru_cache(maxsize=256)
def _indices(media: tuple[Material, ...], wavelengths: tuple[float, ...]) -> list[list[float]]:
    return [[medium.refractive_index(w) for w in wavelengths] for medium in (AIR, *media)]


def _with(rays: Rays, point: Tensor, direction: Tensor) -> Rays:
    (x, y, z), (l, m, n) = point.unbind(-1), direction.unbind(-1)
    return replace(rays, x=x, y=y, z=z, l=l, m=m, n=n)


def _about_x(angle: Tensor) -> Tensor:
    one, zero, c, s = torch.ones_like(angle), torch.zeros_like(angle), torch.cos(angle), torch.sin(angle)
    return torch.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def _about_y(angle: Tensor) -> Tensor:
    one, zero, c, s = torch.ones_like(angle), torch.zeros_like(angle), torch.cos(angle), torch.sin(angle)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
