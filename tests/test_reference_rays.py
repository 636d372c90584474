"""Rays traced to 40 digits by another program: those of tests/data, and all of them if ../shared exists."""

import json

import pytest
import torch
from examples import WAVELENGTHS
from reference_files import SHIPPED, original_of
from reference_lenses import tabulated_lens

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.rays import launch
from tasklens.optics.tracing.trace import trace_full

REFERENCE = SHIPPED / "reference" / "rays.json"
ENTRIES = {  # by name: every lens is traced once, with more rays if ../shared has more
    entry["name"]: entry
    for path in (REFERENCE, original_of(REFERENCE))
    if path.exists()
    for entry in json.loads(path.read_text())["lenses"]
}
LENSES = list(ENTRIES.values())


def test_kinds_of_lenses():
    """Spheres alone, large conics, r^2 terms, aspheres to r^16, stops in front and inside."""
    assert len(LENSES) >= 4
    surfaces = [surface for entry in LENSES for surface in entry["surfaces"]]
    assert any(not any(s["even_asphere"] or s["conic"] for s in entry["surfaces"]) for entry in LENSES)
    assert max(abs(s["conic"]) for s in surfaces) > 100 and max(len(s["even_asphere"]) for s in surfaces) == 8
    assert any(s["even_asphere"] and s["even_asphere"][0] for s in surfaces)
    assert {entry["stop_index"] > 0 for entry in LENSES} == {False, True}
    for entry in LENSES:
        assert {trace["wavelength_um"] for trace in entry["traces"]} == set(WAVELENGTHS)
        assert any("surface_points" in trace and trace["field_deg"][0] for trace in entry["traces"])


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_rays(entry, dtype):
    lens = tabulated_lens(entry, dtype)
    track = entry["image_z"]
    image, direction, path = (1e-12, 1e-13, 1e-12) if dtype == torch.float64 else (max(1e-5, 3e-7 * track),) * 3
    for reference in entry["traces"]:
        origin = torch.tensor(reference["origin"], dtype=dtype)
        direction_cosines = torch.tensor(reference["direction"], dtype=dtype)
        indices = lens.refractive_indices((reference["wavelength_um"],))
        rays, record = trace_full(lens, launch(*origin.T[:, None], *direction_cosines), indices)
        assert rays.valid.all()
        expected = torch.tensor(reference["image_xy"], dtype=torch.float64)
        actual = torch.stack([rays.x[0], rays.y[0]], -1).double()
        torch.testing.assert_close(actual, expected, rtol=0, atol=image)
        actual = torch.stack([rays.l[0], rays.m[0], rays.n[0]], -1).double()
        expected = torch.tensor(reference["image_direction"], dtype=torch.float64)
        torch.testing.assert_close(actual, expected, rtol=0, atol=direction)
        expected = torch.tensor(reference["optical_path"], dtype=torch.float64)
        torch.testing.assert_close(
            rays.path[0].double(), expected, rtol=1e-6 if dtype == torch.float32 else 0, atol=path
        )
        if "surface_points" in reference:
            expected = torch.tensor(reference["surface_points"], dtype=torch.float64)
            actual = torch.stack([torch.stack([r.x[0], r.y[0], r.z[0]], -1) for r in record], 1).double()
            torch.testing.assert_close(actual, expected, rtol=0, atol=image)


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
def test_paraxial(entry):
    lens = tabulated_lens(entry)
    for i, wavelength in enumerate(WAVELENGTHS):
        first_order = paraxial(lens, wavelength)
        assert float(first_order.efl) == pytest.approx(entry["paraxial"]["efl"][i], rel=0, abs=1e-10)
        assert float(first_order.bfl) == pytest.approx(entry["paraxial"]["bfl"][i], rel=0, abs=1e-10)
        pupil = entry["paraxial"]["entrance_pupil_z"][i]
        assert float(first_order.entrance_pupil_z) == pytest.approx(pupil, rel=0, abs=1e-10)
