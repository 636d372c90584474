"""Comparisons of our spots and focal lengths with numbers that are published or stand in the lenses' files."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from lens_cases import FINE, FRACTIONS, GRID, SPOT_UM, Case, difference, square_grid, view_along_y, words, worst
from reference_files import reference_files
from torch import Tensor

from tasklens.materials.material import D_LINE
from tasklens.materials.zemax_text import read_lines
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays, RayStatus, launch
from tasklens.optics.tracing.trace import trace, trace_full
from tasklens.optics.view import View

CODEV = 0.05  # relative tolerance of CODE V's spot diameters


def file_spots(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """RMS radius about the centroid of the file's rays, and of the subset that the file kept."""
    for case in cases:
        lens = replace(case.lens, semi_diameter=torch.full_like(case.lens.semi_diameter, torch.inf))
        start, rays = through_paraxial_pupil(case.lens, case.view, square_grid(GRID))
        inside = vertex_planes_inside(lens, case.view, start)
        inside_rays = replace(rays, status=torch.where(inside, rays.status, int(RayStatus.MISSED)).to(torch.int8))
        ours, alike = (1e3 * rms_spot_radius(beam, centroid(beam)) for beam in (rays, inside_rays))
        by_field = {spot["field"]: spot for spot in case.content["reference"]["spots"]}
        filed, passed = (
            torch.tensor([by_field[fraction].get(key) or math.nan for fraction in FRACTIONS], dtype=torch.float64)
            for key in ("rms_um_d", "passed_d")
        )
        row = (case.name, words(ours, 2), words(filed, 2), difference(worst(ours, filed), SPOT_UM))
        shares = (inside_rays.valid.double().mean((1, 2)), passed)
        yield *row, *(words(v, 3) for v in shares), difference(worst(alike, filed), SPOT_UM)


def through_paraxial_pupil(lens: Lens, view: View, pupil: Tensor, vergence: float = 0.0) -> tuple[Rays, Rays]:
    """Trace rays through the paraxial entrance pupil, neither aimed at a stop inside nor vignetted by the stop.

    `vergence` is 1 / distance of the object from the first vertex [1/mm]. The tangents of the fields are those of the
    rays through the centre of the pupil.

    Returns:
        Rays (F, W, N) as launched and on the image plane.
    """
    first_order = paraxial(lens, view.reference_um)
    z, tangents = first_order.entrance_pupil_z, view.tangents[:, None, None]
    point = pupil * first_order.entrance_pupil_radius / (1 + z * vergence) - tangents * z
    slope = tangents * (1 + z * vergence) + vergence * point
    n = torch.rsqrt(1 + slope.square().sum(-1)).expand(-1, len(view.wavelengths_um), -1)
    rays = launch(point[..., 0], point[..., 1], torch.zeros_like(n), slope[..., 0] * n, slope[..., 1] * n, n)
    at_stop = torch.arange(len(lens.media)) == lens.stop
    lens = replace(lens, semi_diameter=torch.where(at_stop, torch.inf, lens.semi_diameter))
    return rays, trace(lens, rays, lens.refractive_indices(view.wavelengths_um))


def vertex_planes_inside(lens: Lens, view: View, rays: Rays) -> Tensor:
    """Return True for rays that cross each vertex plane at a point where the sag of the surface is real.

    The program behind the files' reference starts its iteration there; it loses all other rays, even if they meet
    the surface.
    """
    _, behind_each = trace_full(lens, rays, lens.refractive_indices(view.wavelengths_um))
    inside = torch.ones_like(rays.valid)
    from_vertex = torch.zeros(())
    for i, behind in enumerate(behind_each):
        distance = (from_vertex - rays.z) / rays.n
        x, y = rays.x + distance * rays.l, rays.y + distance * rays.m
        inside = inside & ((1 + lens.conic[i]) * lens.curvature[i] ** 2 * (x.square() + y.square()) <= 1)
        rays, from_vertex = behind, lens.thickness[i]
    return inside


def codev(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """The largest RMS spot diameter over the fields of the Zemax file, all colours weighted, and CODE V's.

    Once without clear apertures, once clipped by the semi-diameters that are written in the file (DIAM), which Zemax
    calls automatic.
    """
    catalogues = reference_files("glass/*.AGF")
    pupil = square_grid(5 if tiny else FINE)
    for case in cases:
        published = case.content["reference"]["codev_max_rms_spot_diameter_um"]
        source = source_of(case.path)
        if published is None or source is None:
            continue
        imported = zemax.read(source, catalogues)
        lines = read_lines(source)
        weights = [line.number(2) for line in lines if line.keyword == "WAVM"][: len(imported.wavelengths_um)]
        semi_diameters = [line.number(0) for line in lines if line.keyword == "DIAM" and line.indented][1:-1]
        radii = torch.tensor([value or math.inf for value in semi_diameters], dtype=torch.float64)
        radii[imported.lens.stop] = imported.lens.semi_diameter[imported.lens.stop]
        clipped = replace(imported.lens, semi_diameter=radii)
        row, shares = [], []
        for lens in (imported.lens, clipped):
            rays = rays_of_file(imported, lens, pupil)
            row.append(2e3 * weighted_rms(rays, torch.tensor(weights)).max().item())
            shares.append(rays.valid.double().mean((1, 2)).min().item())
        apart = [value / published - 1 for value in row]
        star = " *" if min(map(abs, apart)) > CODEV else ""
        percent = [f"{100 * value:+.1f}" for value in apart]
        near = f"{imported.object_distance_mm:g}" if math.isfinite(imported.object_distance_mm) else "infinite"
        cells = (case.name, near, f"{published:.2f}", f"{row[0]:.2f}", percent[0])
        yield *cells, f"{row[1]:.2f}", percent[1] + star, f"{shares[1]:.3f}"


def rays_of_file(imported: Prescription, lens: Lens, pupil: Tensor) -> Rays:
    """Trace rays of the fields of a Zemax file in its wavelengths, from its object."""
    wavelength = imported.wavelengths_um[imported.primary]
    kind, points = imported.fields
    if math.isinf(imported.object_distance_mm):
        tangents = [math.tan(math.radians(y)) for _, y in points]
        return trace_fields(lens, view_along_y(lens, tangents, imported.wavelengths_um), pupil)
    if kind != "real_image_height_mm":
        raise NotImplementedError(f"fields by {kind} of a near object")
    vergence = 1 / imported.object_distance_mm
    chief = torch.zeros(1, 2, dtype=torch.float64)

    def height(tangent: float) -> float:
        view = view_along_y(lens, [tangent], (wavelength,))
        return float(through_paraxial_pupil(lens, view, chief, vergence)[1].y)

    tangents = [solve(height, y) for _, y in points]
    return through_paraxial_pupil(lens, view_along_y(lens, tangents, imported.wavelengths_um), pupil, vergence)[1]


def solve(function: Callable[[float], float], value: float) -> float:
    """Argument near 0 at which an almost linear function has a value, by the secant method."""
    if value == 0:
        return 0.0
    slope = function(1e-4) / 1e-4
    a, b = 0.0, value / slope
    fa, fb = -value, function(b) - value
    for _ in range(50):
        if abs(fb) < 1e-10 or fa == fb:
            break
        a, fa, b = b, fb, b - fb * (b - a) / (fb - fa)
        fb = function(b) - value
    return b


def weighted_rms(rays: Rays, weights: Tensor) -> Tensor:
    """RMS radius (F,) about the centroid, the wavelengths weighted [mm]."""
    share = weights[None, :, None] * rays.valid
    share = share / share.sum((1, 2), keepdim=True)
    middle = [(share * v).sum((1, 2), keepdim=True) for v in (rays.x, rays.y)]
    squared = (rays.x - middle[0]).square() + (rays.y - middle[1]).square()
    return torch.where(rays.valid, share * squared, 0.0).sum((1, 2)).sqrt()


def source_of(path: Path) -> Path | None:
    """Return the Zemax source of a lens, or None."""
    files = [file for file in (path.parent / "source").glob("*") if file.suffix.lower() == ".zmx"]
    return next((file for file in files if file.stem == path.stem), None)


def focal_lengths(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Focal lengths compared with Optiland's and with the published ones."""
    for case in cases:
        published = (case.content["published"] or {}).get("efl")
        ours = float(paraxial(case.lens, D_LINE).efl)
        theirs = f"{float(case.optiland[0].paraxial.f2()):.4f}" if case.optiland else ""
        if published:
            yield case.name, f"{ours:.4f}", theirs, f"{published:.4g}", f"{100 * (ours / published - 1):+.1f}"
