"""Drawings of lenses that have no files of a study: their figures and PSFs are computed."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch

from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import clear_semi_diameters, evaluation_psf
from tasklens.optics.io import prescription
from tasklens.optics.io.lens_files import LensFile
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.psf import psf_notes
from tasklens.report.figures import draw as draw_panels
from tasklens.report.figures import panel
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import write_tensors

_RIM = 1.02  # of a surface without clear aperture, over the radius that light uses
_FIELDS, _COLOURS = 9, 3  # that a panel shows some of


def draw(path: Path, lenses: Mapping[str, LensFile], rays: int) -> None:
    """Draw lenses by their titles one above the other; the suffix of `path` is the format.

    Raises:
        InputError: a lens whose specification has not nine fields and three colours.
    """
    with tempfile.TemporaryDirectory() as folder:
        panels = []
        for k, (title, found) in enumerate(lenses.items()):
            fields, colours = len(found.view.fields), len(found.view.wavelengths)
            if (fields, colours) != (_FIELDS, _COLOURS):
                raise InputError(
                    f"{title}: a drawing needs nine fields and three colours, found {fields} and {colours}"
                )
            files = Path(folder, f"{k}.yaml"), Path(folder, f"{k}.safetensors")
            _write(found, *files, rays)
            panels.append(panel(title, *files))
        draw_panels(path, panels)


def _write(found: LensFile, path: Path, psf: Path, rays: int) -> None:
    """Write the files of a lens as its design would: with clear apertures, figures and PSFs."""
    view, lens = found.view, found.lens
    clear = torch.where(lens.semi_diameter.isinf(), _RIM * clear_semi_diameters(lens, view), lens.semi_diameter)
    lens = replace(lens, semi_diameter=clear)
    spec = {"fields_mm": view.fields.tolist(), "efl_mm": view.efl, "wavelengths_um": list(view.wavelengths)}
    spec |= {"pixel_pitch_um": view.pixel_pitch, "kernel_size": view.kernel_size}
    notes = {**found.content, "spec": spec, "figures": figures(lens, view, rays)}
    prescription.write(path, Prescription(lens), notes)
    grid = evaluation_psf(lens, view, rays)
    tensors = {"psf": grid.float(), "illumination": relative_illumination(lens, view).float()}
    write_tensors(psf, tensors, psf_notes(view, grid))
