"""Existing lenses: our spots, MTF, distortion and illumination compared with Optiland's and with published numbers.

    python benchmarks/existing_lenses.py [--csv existing_lenses.csv] [--lenses US8310767B2 lens1]

The lenses are those in tests/data/lenses and, if the folder exists, in ../shared/data/lenses. Without Optiland (pip
install optiland) its columns are empty. A star marks a difference beyond the tolerance of its table; the reasons are in
docs/results/existing_lenses.md.
"""

import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import pandas
import torch
from timing import arguments, report
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # readers of these files, and lenses in Optiland
from reference_files import reference_files
from reference_lenses import LENS_FILES, reference_lens

from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.materials.material import D_LINE
from tasklens.materials.zemax_text import read_lines
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import (
    centroid,
    chief_points,
    chief_scale,
    distortion,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays, RayStatus, launch
from tasklens.optics.tracing.trace import trace, trace_full
from tasklens.optics.view import View
from tasklens.recognition import object_scenes

FRACTIONS = (0.0, 0.5, 0.7, 1.0)  # of the tangent of the largest field angle
FREQUENCIES = {"cellphone": 100.0, "classical": 30.0}  # of the MTF [cycles/mm]
SPOT_UM, MTF, DISTORTION_PERCENT, ILLUMINATION, CODEV = 0.01, 0.005, 0.01, 0.02, 0.05  # tolerances; the last relative
_FINE = 101  # pupil points across, for CODE V's spots
_GRID = 33  # pupil points across, as in the reference spots
_RIM = 2048  # rays of the rim, for the illumination
_WIDEST = 8  # width of a PSF over its largest RMS radius
_BINS = 1000  # of Optiland's line spread function


@dataclass(frozen=True)
class Case:
    """A lens of the reference data at the d line, without clear apertures, and its numbers in the file.

    Attributes:
        path: its JSON file.
        content: content of that file.
        lens: the lens.
        view: the fields `FRACTIONS`, along +y.
        optiland: our lens in Optiland, and its fields; None without it.
    """

    path: Path
    content: dict
    lens: Lens
    view: View
    optiland: tuple | None

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.stem


def read(path: Path, peer: ModuleType | None) -> Case:
    """Read a lens."""
    content = json.loads(path.read_text())
    lens = reference_lens(path)
    largest = math.tan(math.radians(content["half_field_deg"]))
    view = view_along_y(lens, [fraction * largest for fraction in FRACTIONS], (D_LINE,))
    return Case(path, content, lens, view, peer and peer.in_optiland(lens, view))


def view_along_y(lens: Lens, tangents: Iterable[float], wavelengths: tuple[float, ...]) -> View:
    """View of fields along +y with direction tangents, in relation to the focal length of the lens."""
    efl = float(paraxial(lens, wavelengths[len(wavelengths) // 2]).efl)
    fields = torch.tensor([[0.0, efl * tangent] for tangent in tangents], dtype=torch.float64)
    return View(fields, efl, wavelengths, 1.8, 51)


def square_grid(points: int) -> Tensor:
    """Points of a square grid inside the unit disc, `points` across."""
    line = torch.linspace(-1, 1, points, dtype=torch.float64)
    grid = torch.cartesian_prod(line, line)
    return grid[grid.norm(dim=-1) <= 1 + 1e-9]


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


def worst(ours: Tensor, others: Tensor) -> float:
    """Return the largest difference where both are finite, or NaN if there is none."""
    differences = (ours - others).abs()
    differences = differences[differences.isfinite()]
    return float(differences.max()) if differences.numel() else math.nan


def words(values: Tensor | None, digits: int) -> str:
    """Numbers of the fields in one cell."""
    if values is None:
        return ""
    return " / ".join(f"{v:.{digits}f}" if math.isfinite(v) else "–" for v in values.flatten().tolist())


def difference(value: float, tolerance: float) -> str:
    """A difference, with a star beyond the tolerance."""
    return "" if math.isnan(value) else f"{value:.1e}{' *' if value > tolerance else ''}"


def spots(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """RMS radius about the centroid: aimed at the stop to compare with Optiland, by the paraxial pupil for the file."""
    pupil = square_grid(5 if tiny else _GRID)
    for case in cases:
        rays = trace_fields(case.lens, case.view, pupil)
        ours, theirs, passed, apart = 1e3 * rms_spot_radius(rays, centroid(rays)), None, None, math.nan
        ray_by_ray = math.nan
        if case.optiland:
            theirs, points = optiland_spots(case, pupil), optiland_points(case, pupil)
            passed, apart = points.isfinite().all(-1).double().mean(-1), worst(ours, theirs)
            mine = torch.where(rays.valid[:, 0, :, None], torch.stack([rays.x, rays.y], -1)[:, 0], torch.nan)
            ray_by_ray = 1e3 * worst(mine, points)
        row = (case.name, words(ours, 2), words(theirs, 2), words(passed, 3), difference(apart, SPOT_UM))
        yield *row, difference(ray_by_ray, SPOT_UM)


def file_spots(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """RMS radius about the centroid of the file's rays, and of the subset that the file kept."""
    for case in cases:
        lens = replace(case.lens, semi_diameter=torch.full_like(case.lens.semi_diameter, torch.inf))
        start, rays = through_paraxial_pupil(case.lens, case.view, square_grid(_GRID))
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


def optiland_spots(case: Case, pupil: Tensor) -> Tensor:
    """RMS radius [um] by Optiland's spot diagram."""
    from optiland.analysis import SpotDiagram
    from optiland_lenses import Points

    def radius(optic, field: tuple) -> list[float]:
        diagram = SpotDiagram(optic, [field], [D_LINE], distribution=Points(pupil), reference="centroid")
        return [1e3 * float(diagram.rms_spot_radius()[0][0])]

    return optiland_fields(case, radius, 1)[0]


def optiland_points(case: Case, pupil: Tensor) -> Tensor:
    """Image points (F, N, 2) of Optiland's rays [mm]; NaN for lost rays."""
    x, y = pupil.T.numpy()

    def points(optic, field: tuple) -> list[float]:
        rays = optic.trace_generic(0 * x + field[0], 0 * x + field[1], x, y, D_LINE)
        return [*rays.x, *rays.y]

    return optiland_fields(case, points, 2 * len(pupil)).reshape(2, len(pupil), -1).permute(2, 1, 0)


def optiland_fields(case: Case, value: Callable, count: int) -> Tensor:
    """Numbers (count, F) of each field by `value`; NaN if Optiland's iteration does not aim every ray."""
    optic, fields = case.optiland
    columns = []
    for field in map(tuple, fields):
        try:
            columns.append(value(optic, field))
        except ValueError:
            columns.append([math.nan] * count)
    return torch.tensor(columns, dtype=torch.float64).T


def mtfs(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Geometric MTF, tangential and sagittal, compared with Optiland's."""
    pupil = square_grid(5 if tiny else _GRID)
    for case in cases:
        frequency = FREQUENCIES[case.path.parent.name]
        ours = geometric_mtf(trace_fields(case.lens, case.view, pupil), case.view.directions, [frequency])
        theirs, apart = (None, None), math.nan
        if case.optiland:
            theirs = optiland_mtf(case, pupil, frequency, 10 if tiny else _BINS)
            apart = max(worst(a[:, 0], b) for a, b in zip(ours, theirs, strict=True))
        pairs = zip(ours, theirs, strict=True)
        yield case.name, f"{frequency:g}", *(words(v, 3) for pair in pairs for v in pair), difference(apart, MTF)


def optiland_mtf(case: Case, pupil: Tensor, frequency: float, bins: int) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF by Optiland's GeometricMTF, whose last frequency is `frequency`."""
    from optiland.mtf import GeometricMTF
    from optiland_lenses import Points

    how = {"distribution": Points(pupil), "num_points": bins, "max_freq": frequency, "scale": False}

    def contrasts(optic, field: tuple) -> list[float]:
        return [float(curve[-1]) for curve in GeometricMTF(optic, [field], D_LINE, **how).mtf[0]]

    tangential, sagittal = optiland_fields(case, contrasts, 2)
    return tangential, sagittal


def distortions(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Distortion, relative to chief rays near the axis, compared with Optiland's, at fractions of the field angle."""
    steps = 3 if tiny else 11
    for case in cases:
        angle = math.atan(float(case.view.tangents[-1, 1]))
        view = view_along_y(case.lens, [math.tan(angle * k / (steps - 1)) for k in range(steps)], (D_LINE,))
        ours = 100 * distortion(view.fields * chief_scale(case.lens, view), chief_points(case.lens, view))
        theirs, apart = None, math.nan
        if case.optiland:
            from optiland.analysis import Distortion

            try:
                percent = list(map(float, Distortion(case.optiland[0], [D_LINE], num_points=steps).data[0]))
            except ValueError:  # Optiland cannot aim a chief ray
                percent = [math.nan] * steps
            theirs = torch.tensor(percent, dtype=torch.float64)
            apart = worst(ours[1:], theirs[1:])
        picked = [(steps - 1) // 2, -1]
        row = (case.name, words(ours[picked], 3), words(theirs if theirs is None else theirs[picked], 3))
        yield *row, difference(apart, DISTORTION_PERCENT)


def illuminations(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Relative illumination compared with the area inside the rim of Optiland's rays in direction cosines."""
    count = 64 if tiny else _RIM
    for case in cases:
        ours = relative_illumination(case.lens, case.view)
        theirs, apart = None, math.nan
        if case.optiland:
            area = optiland_areas(case, count)
            theirs = area / area[0]
            apart = worst(ours[1:], theirs[1:])
        cosines = (1 + case.view.tangents.square().sum(-1)) ** -2
        row = (case.name, words(ours[1:], 4), words(theirs if theirs is None else theirs[1:], 4))
        yield *row, difference(apart, ILLUMINATION), words(cosines[1:], 4)


def optiland_areas(case: Case, count: int) -> Tensor:
    """Area inside the pupil's rim in the plane of the direction cosines (l, m) behind the lens, by Green's theorem."""
    x, y = rim(count).T.numpy()

    def area(optic, field: tuple) -> list[float]:
        rays = optic.trace_generic(0 * x + field[0], 0 * x + field[1], x, y, D_LINE)
        l, m = (torch.as_tensor(v, dtype=torch.float64) for v in (rays.L, rays.M))
        return [abs(float(0.5 * (l * m.roll(-1) - m * l.roll(-1)).sum()))]

    return optiland_fields(case, area, 1)[0]


def codev(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """The largest RMS spot diameter over the fields of the Zemax file, all colours weighted, and CODE V's.

    Once without clear apertures, once clipped by the semi-diameters that are written in the file (DIAM), which Zemax
    calls automatic.
    """
    catalogues = reference_files("glass/*.AGF")
    pupil = square_grid(5 if tiny else _FINE)
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


def captures(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Compare captures through PSFs of our rays and of Optiland's: the effect of ray errors on a capture."""
    images = object_scenes.render(2 if tiny else 16, 128, seed=0).images.float() / 255
    pupil = square_grid(9 if tiny else _FINE)
    for case in (item for item in cases if item.optiland):
        rays, points = trace_fields(case.lens, case.view, pupil), optiland_points(case, pupil)[:, None]
        lost = torch.where(points.isfinite().all(-1), int(RayStatus.OK), int(RayStatus.MISSED)).to(torch.int8)
        x, y = points.nan_to_num().unbind(-1)
        theirs = replace(rays, x=x, y=y, status=lost)
        centre = chief_points(case.lens, case.view)
        pitch = max(1.8, _WIDEST * float(1e3 * rms_spot_radius(rays, centroid(rays)).nan_to_num().max()) / 51)
        grids = [
            PsfCamera(psf(item, centre, pitch, 51).expand(-1, 3, -1, -1).float()).all_fields(images)
            for item in (rays, theirs)
        ]
        complete = (rays.valid == theirs.valid).all((1, 2))  # if one program loses rays, nothing can be compared
        quality, same = (psnr(item, grids[0]).mean(-1) for item in (images, grids[1]))
        same = torch.where(complete, same, torch.nan)
        worst_level = torch.where(complete, 255 * (grids[0] - grids[1]).abs().amax((1, 2, 3, 4)), torch.nan)
        yield case.name, f"{pitch:.1f}", words(quality, 1), words(same, 1), words(worst_level, 3)


TABLES = (
    (
        f"RMS spot radius about the centroid, d line [um], fields 0 / 0.5 / 0.7 / 1; star: beyond {SPOT_UM} um",
        ("lens", "ours", "Optiland", "share of rays that Optiland passes", "difference", "ray by ray"),
        spots,
    ),
    (
        f"The same through the paraxial pupil beside the files' reference; star: beyond {SPOT_UM} um",
        (
            *("lens", "ours", "file", "difference"),
            *("share of rays inside the vertex planes", "share that the file has", "difference of these alone"),
        ),
        file_spots,
    ),
    (
        f"Geometric MTF, d line, fields 0 / 0.5 / 0.7 / 1; star: beyond {MTF}",
        ("lens", "cycles/mm", "tangential: ours", "Optiland", "sagittal: ours", "Optiland", "difference"),
        mtfs,
    ),
    (
        f"Distortion [%] at half and all of the field angle, d line; star: beyond {DISTORTION_PERCENT}, ten fields",
        ("lens", "ours", "Optiland", "difference"),
        distortions,
    ),
    (
        f"Relative illumination at fields 0.5 / 0.7 / 1, d line; star: beyond {ILLUMINATION}",
        ("lens", "ours", "by Optiland's rays", "difference", "cos^4"),
        illuminations,
    ),
    (
        f"Largest RMS spot diameter over the fields of the file [um]; star: both beyond {100 * CODEV:g} %",
        (
            *("lens", "object [mm]", "CODE V", "ours", "difference [%]"),
            *("clipped by the file's radii", "difference [%]", "least share of rays"),
        ),
        codev,
    ),
    (
        "Captures of 16 images through PSFs of 51 pixels, fields 0 / 0.5 / 0.7 / 1; empty where Optiland loses rays",
        (
            *("lens", "pixels [um]", "PSNR of the sharp image [dB]", "PSNR of the capture by Optiland's rays [dB]"),
            "largest difference of a pixel [levels of 255]",
        ),
        captures,
    ),
    ("Focal length [mm]", ("lens", "ours", "Optiland", "published", "difference [%]"), focal_lengths),
)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--lenses", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--csv", metavar="FILE", help="write all tables, a row for each number")
    options = parser.parse_args(argv)
    warnings.filterwarnings("ignore")  # Optiland's, of rays that miss a surface
    try:
        import optiland_lenses as peer
    except ImportError:
        peer = None
    paths = [path for path in LENS_FILES if path.stem in (options.lenses or [path.stem])]
    begin = time.perf_counter()
    cases = [read(path, peer) for path in (paths[:1] if options.tiny else paths)]
    cells = []
    for title, columns, rows in TABLES:
        table = list(rows(cases, options.tiny))
        report(title, columns, table, options.save)
        cells += [(rows.__name__, lens, *cell) for lens, *row in table for cell in zip(columns[1:], row, strict=True)]
    if options.csv:
        pandas.DataFrame(cells, columns=["table", "lens", "column", "value"]).to_csv(options.csv, index=False)
    print(f"{len(cases)} lenses, {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
