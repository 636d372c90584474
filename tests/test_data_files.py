"""The files of tests/data: small, each with its source, and equal to their originals if those are present."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reference_files import SHARED, SHIPPED, original_of

from tasklens.materials import catalogues
from tasklens.optics.io import zemax

FILES = sorted(path for path in SHIPPED.rglob("*") if path.is_file())
SOURCES = SHIPPED / "SOURCES.md"
COPIES = [path for path in FILES if path.parts[len(SHIPPED.parts)] in ("reference", "lenses", "glass")]
CATALOGUES = [path for path in FILES if path.suffix == ".AGF"]


def test_every_file_has_a_source():
    text = SOURCES.read_text()
    assert [path.name for path in FILES if path != SOURCES and f"{path.name}`" not in text] == []


def test_they_stay_small():
    assert sum(path.stat().st_size for path in FILES) < 600_000


RAYS = ("origin", "image_xy", "image_direction", "optical_path", "surface_points")


def to_double(value):
    """Decimal strings as the nearest doubles, in nested lists."""
    return [to_double(item) for item in value] if isinstance(value, list) else float(value)


def assert_part_of(path: Path, original: Path) -> None:
    """Every number and ray is in the original; a lens file gives the same prescription."""
    if path.name == "rays.json":
        copy, source = json.loads(path.read_text()), json.loads(original.read_text())
        assert copy["meta"] == source["meta"]
        for entry, whole in zip(copy["lenses"], source["lenses"], strict=True):
            assert all(any(part.items() <= full.items() for full in whole["traces"]) for part in entry["traces"])
            assert entry | {"traces": []} == {key: whole[key] for key in entry} | {"traces": []}
    elif path.name == "tilted.json":
        copy, source = json.loads(path.read_text()), json.loads(original.read_text())
        assert copy["meta"].items() <= source["meta"].items()
        whole = {entry["name"]: entry for entry in source["lenses"]}
        for entry in copy["lenses"]:
            for case, full in zip(entry["cases"], whole[entry["name"]]["cases"], strict=True):
                rays = {key: to_double(full["traces"][-1][key][:4]) for key in RAYS}
                assert {key: case["traces"][0][key] for key in RAYS} == rays
                for surface, source_surface in zip(case["surfaces"], full["surfaces"], strict=True):
                    assert surface == {key: to_double(source_surface[key]) for key in surface}
    elif path.suffix == ".AGF":
        assert catalogues.read(path).items() <= catalogues.read(original).items()
    elif path.suffix == ".csv":
        assert set(path.read_text().splitlines()) <= set(original.read_text().splitlines())
    elif path.suffix == ".json":
        assert path.read_bytes() == original.read_bytes()
    elif path.name != "lens2.zmx":  # no catalogue has its glass, so it is refused
        prescription, expected = (zemax.read(file, CATALOGUES) for file in (path, original))
        assert replace(prescription, lens=None) == replace(expected, lens=None)
        assert (prescription.lens.media, prescription.lens.stop) == (expected.lens.media, expected.lens.stop)
        for name in ("curvature", "conic", "alpha", "thickness", "semi_diameter"):
            assert torch.equal(getattr(prescription.lens, name), getattr(expected.lens, name)), name


@pytest.mark.skipif(not SHARED.exists(), reason="the files that these were cut from are not here")
def test_a_part_says_what_the_whole_says():
    assert len(COPIES) == 28
    for path in COPIES:
        assert_part_of(path, original_of(path))
