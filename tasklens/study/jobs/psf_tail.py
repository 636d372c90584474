"""Tables of core, tail and encircled energy of the PSFs of all lenses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas
import torch

from tasklens.optics.analysis import spots
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.io import prescription
from tasklens.optics.lens import Lens
from tasklens.optics.rays import passing
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.files import write_rows
from tasklens.show.publish import publish
from tasklens.study.report_jobs import TailsJob

_NOTE = """\
Study `{study}`. Means over the centres of the cells of the grading, of rays about the image point of the chief ray, on
which PSFs are centred. The core holds 50 % of the light that passes the clear apertures; the tail is outside three core
radii. The RMS spot is about the chief ray (in table 1 about the centroid). A sharp core with a long tail has a large
ratio of RMS to core radius: 1 for a uniform disc, 1.2 for a Gaussian spot."""

_TAIL = 3.0  # radius outside which light belongs to the tail [core radii]
RADII_UM = [round(10 ** (k / 20), 3) for k in range(-20, 61)]  # 20 per decade, 0.1 um to 1 mm


def run(
    settings: TailsJob, lenses: Sequence[Path], csv: Path, md: Path, fields_csv: Path, encircled_energy: Path
) -> None:
    """Write the table of tails, its rows by field, and the encircled energy; `lenses` are files of `lens_keys`."""
    by_field, curves = [], []
    for (lens, seed), path in zip(settings.lens_keys, lenses, strict=True):
        view = view_of_spec(settings.specs[lens]).at(settings.fields)
        fields, curve = tail(prescription.read(path)[0].lens, view, settings.rays)
        by_field += [{"lens": lens, "seed": seed} | row for row in fields]
        curves += [{"lens": lens, "seed": seed} | row for row in curve]
    publish(csv, md, summarise(by_field), _NOTE.format(study=settings.study))
    write_rows(fields_csv, by_field)
    write_rows(encircled_energy, curves)


def tail(lens: Lens, view: View, rays: int) -> tuple[list[dict], list[dict]]:
    """Measure the tail and the encircled energy of each field, with `rays` pupil points per field and wavelength.

    Distances are from the image point of the chief ray. Energies are fractions of the light that passes the clear
    apertures.

    Returns:
        A row per field: `core_radius_um` and `radius_80_um` encircle 50 % and 80 % of the light, `tail_energy` is the
        fraction outside 3 core radii (NaN if the core is infinite), `energy_outside_window` the fraction outside the
        square PSF window, `rms_chief_ray_um` the RMS distance of the valid rays.
        Rows (field, radius_um, fraction) of the encircled energy.
    """
    traced, centre = spots.trace_fields(lens, view, sobol_disc(rays, seed=0)), spots.chief_points(lens, view)
    core = spots.encircled_energy_radius(traced, centre, 0.5)
    offset = torch.stack([traced.x, traced.y], -1) - centre[:, None, None]
    inside = traced.valid & (offset.abs().amax(-1) < view.kernel_size * view.pixel_pitch_um / 2e3)
    tail_energy = 1 - spots.encircled_energy(traced, centre, _TAIL * core[:, None])[:, 0]
    figures = {
        "core_radius_um": 1e3 * core,
        "radius_80_um": 1e3 * spots.encircled_energy_radius(traced, centre, 0.8),
        "tail_energy": torch.where(core.isfinite(), tail_energy, torch.nan),
        "energy_outside_window": 1 - inside.sum((1, 2)).double() / passing(traced),
        "rms_chief_ray_um": 1e3 * spots.rms_spot_radius(traced, centre),
    }
    columns = {name: values.tolist() for name, values in figures.items()}
    by_field = [
        {"field": field} | {name: values[field] for name, values in columns.items()} for field in range(len(core))
    ]
    curves = spots.encircled_energy(traced, centre, torch.tensor(RADII_UM, dtype=torch.float64) / 1e3).tolist()
    curve = [
        {"field": field, "radius_um": radius, "fraction": fraction}
        for field, fractions in enumerate(curves)
        for radius, fraction in zip(RADII_UM, fractions, strict=True)
    ]
    return by_field, curve


def summarise(by_field: Sequence[Mapping[str, Any]]) -> pandas.DataFrame:
    """Compute a row per lens: means over fields, their ratio of RMS to core radius, and means over seeds of these.

    Args:
        by_field: rows (lens, seed, field, ...). Several seeds add columns `_std`.
    """
    means = pandas.DataFrame(by_field).drop(columns="field").groupby(["lens", "seed"], sort=False).mean(skipna=False)
    means["rms_over_core"] = means["rms_chief_ray_um"] / means["core_radius_um"]
    lenses = means.groupby("lens", sort=False)
    table = lenses.mean(skipna=False)
    if means.index.get_level_values("seed").nunique() > 1:
        table = table.join(lenses.std(ddof=1).add_suffix("_std"))
    return table.reset_index()
