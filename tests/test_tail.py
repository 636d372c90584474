"""Tails of PSFs with known numbers: discs, Gaussian spots and cores with a halo."""

import math
from dataclasses import replace

import pandas
import pytest
import torch
from examples import f64, make_lens, rays_on_image

from tasklens.optics.analysis import spots
from tasklens.optics.analysis.datasheet import figures
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import distances, encircled_energy
from tasklens.optics.rays import RayStatus
from tasklens.optics.view import view_of_spec
from tasklens.settings.specification import Spec
from tasklens.show.publish import publish
from tasklens.study.jobs.psf_tail import RADII_UM, summarise, tail


def tail_of(monkeypatch, points, valid=None, centre=(0.0, 0.0), lost=RayStatus.MISSED) -> tuple[dict, pandas.DataFrame]:
    """Tail and curve of one field whose rays land on `points` (N, 2) [um] about a chief ray at `centre` [um]."""
    x, y = (points + f64(centre)).T / 1e3
    rays = rays_on_image(x[None, None], y[None, None], valid)
    rays = replace(rays, status=rays.status * lost)
    monkeypatch.setattr(spots, "trace_fields", lambda *arguments: rays)
    monkeypatch.setattr(spots, "chief_points", lambda *arguments: f64([centre]) / 1e3)
    by_field, curve = tail(None, view_of_spec(Spec()), len(points))
    return by_field[0], pandas.DataFrame(curve)


def test_a_gaussian_spot(monkeypatch):
    """exp(-r^2 / 2 s^2): core s sqrt(2 ln 2), RMS over core 1 / sqrt(ln 2) = 1.20, outside 3 cores 2^-9."""
    u, v = sobol_disc(8192, 0).T
    radius = u**2 + v**2  # uniform over 0 .. 1
    points = torch.stack([u, v], -1) * (torch.sqrt(-2 * torch.log1p(-radius)) / torch.sqrt(radius))[:, None] * 5
    row, curve = tail_of(monkeypatch, points)
    assert row["core_radius_um"] == pytest.approx(5 * math.sqrt(2 * math.log(2)), rel=2e-3)
    assert row["rms_chief_ray_um"] / row["core_radius_um"] == pytest.approx(1 / math.sqrt(math.log(2)), rel=1e-2)
    assert row["tail_energy"] == pytest.approx(2**-9, rel=0.1)
    expected = 1 - torch.exp(-0.5 * (f64(RADII_UM) / 5) ** 2)
    torch.testing.assert_close(f64(curve["fraction"].tolist()), expected, rtol=0, atol=2e-3)


def test_a_core_in_a_halo(monkeypatch):
    """Of ten rays six land 2 um from the centre, two at 20 um, one at 100 um outside the window, one is lost."""
    points = f64([[2, 0]] * 6 + [[0, 20]] * 2 + [[0, 100], [0, 0]])
    valid = torch.tensor([True] * 9 + [False])[None, None]
    row, curve = tail_of(monkeypatch, points, valid)
    assert row["core_radius_um"] == pytest.approx(2) and row["radius_80_um"] == pytest.approx(20)
    assert row["tail_energy"] == pytest.approx(0.4) and row["energy_outside_window"] == pytest.approx(0.2)
    assert row["rms_chief_ray_um"] == pytest.approx(math.sqrt((6 * 4 + 2 * 400 + 10_000) / 9))
    at = curve.set_index("radius_um")["fraction"]
    assert [at[1.778], at[2.239], at[1000.0]] == pytest.approx([0, 0.6, 0.9])


def test_vignetted_light_is_left_out(monkeypatch):
    """A clear aperture stops six of ten rays: half of the other four is the core, and no light counts as lost."""
    points = f64([[1, 0], [0, 2], [3, 0], [0, 100]] + [[0, 0]] * 6)
    valid = torch.tensor([True] * 4 + [False] * 6)[None, None]
    row, curve = tail_of(monkeypatch, points, valid, lost=RayStatus.VIGNETTED)
    assert row["core_radius_um"] == pytest.approx(2) and row["radius_80_um"] == pytest.approx(100)
    assert row["energy_outside_window"] == row["tail_energy"] == pytest.approx(0.25)
    assert curve.set_index("radius_um")["fraction"][1000.0] == 1


def test_a_field_without_a_core_has_no_tail_energy(monkeypatch):
    points, lost = torch.zeros(4, 2, dtype=torch.float64), torch.tensor([True, False, False, False])[None, None]
    row, _ = tail_of(monkeypatch, points, lost)
    assert math.isinf(row["core_radius_um"]) and math.isnan(row["tail_energy"])
    assert row["energy_outside_window"] == 0.75


def test_encircled_energy_is_a_count():
    """Against a count of the rays within each radius, also on the radius itself."""
    points = torch.randn(2, 3, 50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rays = rays_on_image(points[..., 0], points[..., 1])
    centre = f64([[0.0, 0.0], [0.5, -0.5]])
    radii = torch.cat([f64([0.0, 0.3, 1.0, 9.0]), distances(rays, centre)[0, 0, :3]])
    actual = encircled_energy(rays, centre, radii)
    away = (points - centre[:, None, None]).norm(dim=-1)
    expected = torch.stack([(away <= r * (1 + 1e-15)).double().mean((1, 2)) for r in radii], -1)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-15)


def test_figures_agree_with_the_lens_file():
    """Both use the same rays: core, 80 % radius, energy in the window and RMS about the chief ray."""
    view = view_of_spec(Spec())
    lens = make_lens([0, 0.7, 0], [0.1, 0.4, 2.6], ("air", "COC", "air"), semi_diameter=[0.5, torch.inf, torch.inf])
    by_field, curve = tail(lens, view, 256)
    expected = figures(lens, view, 256)
    for name in ("core_radius_um", "radius_80_um", "rms_chief_ray_um"):
        assert [row[name] for row in by_field] == pytest.approx(expected[name], nan_ok=True)
    assert [1 - row["energy_outside_window"] for row in by_field] == pytest.approx(expected["energy_in_window"])
    curve = pandas.DataFrame(curve)
    assert set(curve["field"]) == set(range(9)) and curve.groupby("field")["fraction"].is_monotonic_increasing.all()


def test_table_means_over_fields_and_seeds(tmp_path):
    """Ratios are ratios of means over fields; the mean is NaN if one field is NaN."""
    cores = {("imaging1", 0): [1, 3], ("imaging1", 1): [4, 4], ("imaging2", 0): [1, 1], ("imaging2", 1): [math.inf, 1]}
    rows = []
    for (design, seed), core in cores.items():
        for field, radius in enumerate(core):
            key = {"lens": f"singlet-{design}", "seed": seed, "field": field}
            tail_energy = 0.1 if math.isfinite(radius) else math.nan
            rows.append(key | {"core_radius_um": radius, "tail_energy": tail_energy, "rms_chief_ray_um": 8})
    publish(tmp_path / "psf_tail.csv", tmp_path / "tail.md", summarise(rows), "a note")
    table = pandas.read_csv(tmp_path / "psf_tail.csv").set_index("lens")
    a, b = table.loc["singlet-imaging1"], table.loc["singlet-imaging2"]
    assert a["core_radius_um"] == 3 and a["core_radius_um_std"] == pytest.approx(2**0.5)
    assert a["rms_over_core"] == 3 and a["tail_energy"] == pytest.approx(0.1)
    assert math.isinf(b["core_radius_um"]) and math.isnan(b["tail_energy"])
    assert "nan" not in (tmp_path / "tail.md").read_text()
