"""Rays traced to 40 digits by another program (../shared/reference/rays.json); skipped where the file is absent."""

import json
from pathlib import Path

import pytest
import torch

from tasklens.materials.material import AIR
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.lens import Lens
from tasklens.optics.rays import launch
from tasklens.optics.tracing.trace import trace

REFERENCE = Path(__file__).parents[2] / "shared" / "reference" / "rays.json"
LENSES = json.loads(REFERENCE.read_text())["lenses"] if REFERENCE.exists() else []
pytestmark = pytest.mark.skipif(not LENSES, reason="no reference rays here")


class Tabulated(Lens):
    """A lens whose indices come from the reference file, column by wavelength."""

    def refractive_indices(self, wavelengths):
        return torch.tensor([[1.0] * 3, *self.table], dtype=self.dtype)[:, [WAVELENGTHS.index(w) for w in wavelengths]]


WAVELENGTHS = [0.6563, 0.5893, 0.4861]


def read(entry: dict, dtype=torch.float64) -> Lens:
    surfaces = entry["surfaces"]
    orders = max(len(s["even_asphere"]) for s in surfaces)
    alpha = [s["even_asphere"] + [0.0] * (orders - len(s["even_asphere"])) for s in surfaces]
    column = lambda key: torch.tensor([s[key] for s in surfaces], dtype=dtype)  # noqa: E731
    lens = Tabulated(
        column("curvature"),
        column("conic"),
        torch.tensor(alpha, dtype=dtype).reshape(len(surfaces), orders),
        column("thickness"),
        torch.full((len(surfaces),), torch.inf, dtype=dtype),
        (AIR,) * len(surfaces),
        entry["stop_index"],
    )
    object.__setattr__(lens, "table", [s["n_after"] for s in surfaces])
    return lens


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_rays(entry, dtype):
    lens = read(entry, dtype)
    track = entry["image_z"]
    image, direction, path = (1e-12, 1e-13, 1e-12) if dtype == torch.float64 else (max(1e-5, 3e-7 * track),) * 3
    for reference in entry["traces"]:
        origin = torch.tensor(reference["origin"], dtype=dtype)
        direction_cosines = torch.tensor(reference["direction"], dtype=dtype)
        indices = lens.refractive_indices((reference["wavelength_um"],))
        record = []
        rays = trace(lens, launch(*origin.T[:, None], *direction_cosines), indices, record)
        assert rays.valid.all()
        expected = torch.tensor(reference["image_xy"], dtype=torch.float64)
        found = torch.stack([rays.x[0], rays.y[0]], -1).double()
        torch.testing.assert_close(found, expected, rtol=0, atol=image)
        found = torch.stack([rays.l[0], rays.m[0], rays.n[0]], -1).double()
        expected = torch.tensor(reference["image_direction"], dtype=torch.float64)
        torch.testing.assert_close(found, expected, rtol=0, atol=direction)
        expected = torch.tensor(reference["optical_path"], dtype=torch.float64)
        torch.testing.assert_close(
            rays.path[0].double(), expected, rtol=1e-6 if dtype == torch.float32 else 0, atol=path
        )
        if "surface_points" in reference:
            expected = torch.tensor(reference["surface_points"], dtype=torch.float64)
            found = torch.stack([torch.stack([r.x[0], r.y[0], r.z[0]], -1) for r in record], 1).double()
            torch.testing.assert_close(found, expected, rtol=0, atol=image)


@pytest.mark.parametrize("entry", LENSES, ids=lambda e: e["name"])
def test_paraxial(entry):
    lens = read(entry)
    for i, wavelength in enumerate(WAVELENGTHS):
        found = paraxial(lens, wavelength)
        assert float(found.efl) == pytest.approx(entry["paraxial"]["efl"][i], rel=0, abs=1e-10)
        assert float(found.bfl) == pytest.approx(entry["paraxial"]["bfl"][i], rel=0, abs=1e-10)
        pupil = entry["paraxial"]["entrance_pupil_z"][i]
        assert float(found.entrance_pupil_z) == pytest.approx(pupil, rel=0, abs=1e-10)
