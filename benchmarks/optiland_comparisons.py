"""Comparisons of our spots, MTF, distortion, illumination and captures with those of Optiland's rays."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from lens_cases import FINE, GRID, SPOT_UM, Case, difference, square_grid, view_along_y, words, worst
from torch import Tensor

from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.materials.material import D_LINE
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.mtf import geometric_mtf
from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import (
    centroid,
    chief_points,
    chief_scale,
    distortion,
    rms_spot_radius,
    trace_fields,
)
from tasklens.optics.psf import psf
from tasklens.optics.rays import RayStatus
from tasklens.recognition import object_scenes

MTF, DISTORTION_PERCENT, ILLUMINATION = 0.005, 0.01, 0.02  # tolerances
FREQUENCIES = {"cellphone": 100.0, "classical": 30.0}  # of the MTF [cycles/mm]
_RIM = 2048  # rays of the rim, for the illumination
_WIDEST = 8  # width of a PSF over its largest RMS radius
_BINS = 1000  # of Optiland's line spread function


def spots(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """RMS radius about the centroid: aimed at the stop to compare with Optiland, by the paraxial pupil for the file."""
    pupil = square_grid(5 if tiny else GRID)
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
    pupil = square_grid(5 if tiny else GRID)
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


def captures(cases: list[Case], tiny: bool) -> Iterator[tuple]:
    """Compare captures through PSFs of our rays and of Optiland's: the effect of ray errors on a capture."""
    images = object_scenes.render(2 if tiny else 16, 128, seed=0).images.float() / 255
    pupil = square_grid(9 if tiny else FINE)
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
