"""`tasklens lens captures`: captures of a folder, compared with `simulate`."""

import csv
from pathlib import Path

import numpy
import pytest
import torch
from examples import HEADLINE
from PIL import Image

import tasklens
from tasklens.api import captures
from tasklens.cli.app import main
from tasklens.optics.view import drawn_points

LENS = HEADLINE / "doublet-tasklens.yaml"
OPTIONS = ("--size", "64", "--rays", "256")


@pytest.fixture
def photos(here):
    """Four square photographs in two folders."""
    pixels = numpy.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=numpy.uint8)
    for k, name in enumerate(("cat/a.png", "cat/b.png", "dog/old/a.png", "dog/c.PNG")):
        Path("photos", name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels[k]).save(Path("photos", name))
    return here / "photos"


def run(*words: str) -> int:
    return main(["lens", "captures", str(LENS), *words])


def opened(path: Path) -> torch.Tensor:
    return torch.from_numpy(numpy.array(Image.open(path))).permute(2, 0, 1) / 255


def rows_of(folder: str) -> list[dict[str, str]]:
    with Path(folder, "fields.csv").open() as file:
        return list(csv.DictReader(file))


def test_each_photograph_is_captured_at_its_field(photos, capsys):
    """As by `simulate`, within the 8 bits of a file; the same seed gives the same fields."""
    (photos / "cat" / "notes.txt").touch()
    assert run("photos", "-o", "out", *OPTIONS) == 0
    said = capsys.readouterr().err
    assert "wrote 4 captures to out" in said and "photos: passed over: 1 .txt" in said
    rows = rows_of("out")
    assert sorted(row["file"] for row in rows) == ["cat/a.png", "cat/b.png", "dog/c.png", "dog/old/a.png"]
    lens, view = tasklens.load_lens(LENS)
    drawn = view.at(drawn_points(8, seed=0))
    for row in rows:
        source = next(path for path in photos.rglob("*") if str(path.relative_to(photos)).lower() == row["file"])
        point = float(row["x_mm"]), float(row["y_mm"])
        assert point == tuple(drawn.fields[int(row["field"])].tolist())
        expected = tasklens.simulate(lens, view, opened(source), [point], rays=256)[0]
        torch.testing.assert_close(opened(Path("out", row["file"])), expected.clamp(0, 1), rtol=0, atol=0.51 / 255)
    assert len({row["field"] for row in rows}) > 1
    assert run("photos", "-o", "noisy", *OPTIONS, "--full-well", "6000") == 0
    assert rows_of("noisy") == rows
    assert not torch.equal(opened(Path("noisy/cat/a.png")), opened(Path("out/cat/a.png")))
    assert run("photos", "-o", "corner", *OPTIONS, "--field", "corner") == 0
    assert {row["field"] for row in rows_of("corner")} == {"8"}


def test_photographs_that_cannot_be_read_are_named_before_the_first_capture(photos, monkeypatch, capsys):
    """All of them, so that the same command does it all after they are repaired."""
    monkeypatch.setattr(captures, "_BLOCK", 1)
    for broken in ("cat/a.png", "dog/c.PNG"):
        (photos / broken).rename(photos / f"{broken}.kept")
        (photos / broken).write_text("no image")
    assert run("photos", "-o", "out", *OPTIONS) == 2 and not Path("out").exists()
    assert "2 of 4 images cannot be read" in capsys.readouterr().err
    for broken in ("cat/a.png", "dog/c.PNG"):
        (photos / f"{broken}.kept").replace(photos / broken)
    assert run("photos", "-o", "out", *OPTIONS) == 0 and len(rows_of("out")) == 4


def test_what_cannot_be_captured_is_refused_before_the_first_file(photos, capsys):
    (photos / "empty").mkdir()
    Path("there").mkdir()
    Image.new("RGB", (64, 64)).save(photos / "cat" / "a.jpg")
    for words, message in (
        (("nowhere", "-o", "out"), "nowhere: expected a folder of photographs"),
        (("photos/empty", "-o", "out"), "photos/empty: expected a folder of photographs"),
        (("photos/dog", "-o", "there"), "there: already exists"),
        (("photos", "-o", "out"), "photos: two photographs differ only in their suffix: cat/a"),
        (("photos/dog", "-o", "out", "--size", "20"), "size 20: too small for PSFs of 51 pixels"),
    ):
        assert run(*words) == 2 and message in capsys.readouterr().err
    assert not Path("out").exists()
