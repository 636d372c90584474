"""The files of tests/data: small, each with its source, and equal to what they were cut from where that is there."""

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
    """Digits as the nearest double, in nested lists."""
    return [to_double(each) for each in value] if isinstance(value, list) else float(value)


def assert_part_of(path: Path, original: Path) -> None:
    """Every number and ray stands in the original; a lens reads as the same prescription."""
    if path.name == "rays.json":
        ours, theirs = json.loads(path.read_text()), json.loads(original.read_text())
        assert ours["meta"] == theirs["meta"]
        for entry, whole in zip(ours["lenses"], theirs["lenses"], strict=True):
            assert all(any(part.items() <= full.items() for full in whole["traces"]) for part in entry["traces"])
            assert entry | {"traces": []} == {key: whole[key] for key in entry} | {"traces": []}
    elif path.name == "tilted.json":
        ours, theirs = json.loads(path.read_text()), json.loads(original.read_text())
        assert ours["meta"].items() <= theirs["meta"].items()
        whole = {entry["name"]: entry for entry in theirs["lenses"]}
        for entry in ours["lenses"]:
            for case, full in zip(entry["cases"], whole[entry["name"]]["cases"], strict=True):
                kept = {key: to_double(full["traces"][-1][key][:4]) for key in RAYS}
                assert {key: case["traces"][0][key] for key in RAYS} == kept
                for ours_of, theirs_of in zip(case["surfaces"], full["surfaces"], strict=True):
                    assert ours_of == {key: to_double(theirs_of[key]) for key in ours_of}
    elif path.suffix == ".AGF":
        assert catalogues.read(path).items() <= catalogues.read(original).items()
    elif path.suffix == ".csv":
        assert set(path.read_text().splitlines()) <= set(original.read_text().splitlines())
    elif path.suffix == ".json":
        assert path.read_bytes() == original.read_bytes()
    elif path.name != "lens2.zmx":  # it is refused: its glass is in no catalogue
        found, expected = (zemax.read(file, CATALOGUES) for file in (path, original))
        assert replace(found, lens=None) == replace(expected, lens=None)
        assert (found.lens.media, found.lens.stop) == (expected.lens.media, expected.lens.stop)
        for name in ("curvature", "conic", "alpha", "thickness", "semi_diameter"):
            assert torch.equal(getattr(found.lens, name), getattr(expected.lens, name)), name


@pytest.mark.skipif(not SHARED.exists(), reason="the files that these were cut from are not here")
def test_a_part_says_what_the_whole_says():
    assert len(COPIES) == 28
    for path in COPIES:
        assert_part_of(path, original_of(path))
