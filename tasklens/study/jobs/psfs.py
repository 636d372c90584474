"""PSFs of a lens at the fields where networks are trained, lenses are chosen, and lenses are graded."""

import sys
from pathlib import Path

import torch

from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.psf import energy_inside, psf_notes, window_remark
from tasklens.optics.view import drawn_points, view_of_spec
from tasklens.study.job_settings import PsfJob

_DRAWS, _DRAWS_OF_WAVES = 8, 2  # draws of nine fields for training; a PSF with diffraction takes two seconds


def run(settings: PsfJob, lens: Path, psf: Path) -> None:
    """Write the PSFs of all sets of fields; equal sets are stored once."""
    draws = _DRAWS_OF_WAVES if settings.diffraction else _DRAWS
    drawn = drawn_points(draws, settings.seed).unflatten(0, (draws, -1))
    points, sets = torch.empty(0, 2, dtype=torch.float64), {}
    stored: dict[object, tuple[int, int, int]] = {}
    for name, fields in settings.sets.items():
        if fields not in stored:
            of_set = drawn if fields is None else torch.tensor(fields, dtype=torch.float64)
            stored[fields] = len(points), len(points) + of_set.shape[:2].numel(), len(of_set)
            points = torch.cat([points, of_set.flatten(0, 1)])
        sets[name] = stored[fields]
    view = view_of_spec(settings.spec).at(points)
    design = prescription.read(lens)[0].lens
    grid = evaluation_psf(design, view, settings.rays, diffraction=settings.diffraction)
    if remark := window_remark(energy_inside(grid), view.kernel_size, "take a larger spec.kernel_size"):
        print(f"tasklens: {lens}: {remark}", file=sys.stderr)
    light = relative_illumination(design, view) if settings.sensor else torch.ones(len(points))  # it takes seconds
    notes = psf_notes(view, grid) | {"rays": settings.rays, "diffraction": settings.diffraction}
    psf_files.write(psf, grid, light, sets, notes)
