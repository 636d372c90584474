"""`tasklens lens ...` as a user types it, on our lenses and on Zemax files: what it writes, and its error messages."""

import math
import re
from pathlib import Path

import numpy
import pytest
import torch
import yaml
from lens_command import DOUBLET, FEW, PHONE, SAME, output_of, run
from PIL import Image

import tasklens
from tasklens.optics.io import lens_files
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import read_tensors


@pytest.fixture
def folder(here):
    """The current folder, with an image of random colours."""
    values = numpy.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=numpy.uint8)
    Image.fromarray(values).save("image.png")
    return here


@pytest.mark.slow
def test_lenses_of_one_name_are_told_apart(folder, capsys):
    text = output_of(capsys, "compare", DOUBLET, SAME, *FEW)
    assert [line.split()[0] for line in text.splitlines()[1:3]] == ["doublet-imaging2.yaml", "doublet-imaging2.zmx"]
    (folder / DOUBLET.name).write_bytes(DOUBLET.read_bytes())
    text = output_of(capsys, "compare", DOUBLET, DOUBLET.name, *FEW)
    assert [line.split()[0] for line in text.splitlines()[1:3]] == [str(DOUBLET), DOUBLET.name]
    assert run("draw", DOUBLET, SAME, "-o", "both.png", *FEW) == 0
    assert run("draw", DOUBLET, "-o", "one.png", *FEW) == 0
    with Image.open("both.png") as both, Image.open("one.png") as one:
        assert both.height > 1.5 * one.height


def test_a_drawing_in_vectors(folder, capsys):
    assert run("draw", PHONE, "-o", "phone.svg", *FEW) == 0
    svg = (folder / "phone.svg").read_text()
    assert "<svg" in svg and "<path" in svg and "tasklens: wrote phone.svg" in capsys.readouterr().err


def test_psfs_in_three_formats_are_one(folder):
    for name in ("psf.npz", "psf.safetensors", "psf.png"):
        assert run("psf", DOUBLET, "-o", name, "--kernel-size", 31, *FEW) == 0
    arrays = numpy.load("psf.npz")
    assert arrays["psf"].shape == (9, 3, 31, 31) and arrays["illumination"].shape == (9,)
    assert arrays["psf"].sum((-2, -1)) == pytest.approx(numpy.ones((9, 3)), abs=0.02)
    assert arrays["wavelengths_um"].tolist() == [0.6563, 0.5893, 0.4861] and arrays["pixel_pitch_um"] == 1.8
    tensors, _ = read_tensors(folder / "psf.safetensors")
    torch.testing.assert_close(tensors["psf"], torch.from_numpy(arrays["psf"]).float(), rtol=1e-6, atol=1e-9)
    assert run("psf", DOUBLET, "-o", "up.png", "--kernel-size", 31, "--wavelengths", "0.4861,0.5893,0.6563", *FEW) == 0
    with Image.open("psf.png") as image, Image.open("up.png") as ascending:
        assert (numpy.asarray(image) == numpy.asarray(ascending)).all()
        # The brightest pixel of each PSF is white in one colour.
        assert image.mode == "RGB" and numpy.asarray(image).max() == 255


def test_one_field_and_all_nine(folder):
    """Each field blurs random colours in its own way; a grey image stays grey; a grid has nine."""
    spread = {}
    for field in ("axis", "middle", "corner"):
        assert run("simulate", DOUBLET, "image.png", "-o", f"{field}.png", "--field", field, *FEW) == 0
        with Image.open(f"{field}.png") as capture:
            assert capture.size == (80, 60)
            spread[field] = float(numpy.asarray(capture).std())
    with Image.open("image.png") as image:
        assert max(spread.values()) < 0.5 * float(numpy.asarray(image).std())
    assert len({round(value, 3) for value in spread.values()}) == 3
    assert run("simulate", DOUBLET, "image.png", "-o", "point.png", "--field", "0,0", *FEW) == 0
    assert (folder / "point.png").read_bytes() == (folder / "axis.png").read_bytes()
    assert run("simulate", DOUBLET, "image.png", "-o", "grid.jpg", "--grid", "--full-well", "6000", *FEW) == 0
    with Image.open("grid.jpg") as grid:
        assert grid.size == (3 * 80 + 2 * 4, 3 * 60 + 2 * 4) and grid.format == "JPEG"
    Image.new("RGB", (80, 60), (120, 120, 120)).save("grey.png")
    assert run("simulate", DOUBLET, "grey.png", "-o", "even.png", *FEW) == 0
    with Image.open("even.png") as even:
        assert numpy.abs(numpy.asarray(even).astype(int) - 120).max() <= 1


def test_an_export_with_another_field_of_view(folder):
    """Of a file with a specification, and of a Zemax file."""
    assert run("export", DOUBLET, "-o", "lens.zmx") == 0
    for source, name in ((DOUBLET, "wide.yaml"), (DOUBLET, "wide.zmx"), ("lens.zmx", "wider.yaml")):
        assert run("export", source, "-o", name, "--field-of-view", "50") == 0
        view = lens_files.read(folder / name).view
        assert math.degrees(2 * math.atan(float(view.tangents.norm(dim=-1).max()))) == pytest.approx(50, rel=1e-9)


def test_nothing_is_overwritten_without_consent(folder, capsys):
    for arguments in (
        ("draw", DOUBLET, "-o", "there.png"),
        ("psf", DOUBLET, "-o", "there.npz"),
        ("simulate", DOUBLET, "image.png", "-o", "there.jpg"),
        ("export", DOUBLET, "-o", "there.zmx"),
    ):
        path = folder / arguments[-1]
        path.write_text("mine")
        assert run(*arguments) == 2
        assert capsys.readouterr().err == f"tasklens: {path.name}: already exists; --force overwrites it\n"
        assert path.read_text() == "mine"
    assert run("export", DOUBLET, "-o", "there.zmx", "--force") == 0
    assert (folder / "there.zmx").read_text().startswith("VERS")


# ---- mistakes


def bad_lenses(folder: Path) -> None:
    content = yaml.safe_load(DOUBLET.read_text())
    (folder / "bare.yaml").write_text(yaml.safe_dump({key: content[key] for key in content if key != "spec"}))
    (folder / "broken.yaml").write_text("format: 2\nsurfaces: [1, {")
    (folder / "glass.zmx").write_text(re.sub("GLAS OKP4 .*", "GLAS NOSUCH", SAME.read_text()))
    (folder / "text.zmx").write_text("hello\n")
    (folder / "folder.yaml").mkdir()
    Image.new("RGB", (30, 20)).save(folder / "small.png")


OUT = ("-o", "capture.png", *FEW)
MISTAKES = [
    (("show", "folder.yaml"), "folder.yaml: is a folder; expected a file"),
    (("show", "broken.yaml"), "broken.yaml, line 2, column 16: not valid YAML: expected the node content"),
    (("show", "image.png"), "image.png: expected a lens file, .yaml or .zmx"),
    (("compare", DOUBLET, "bare.yaml"), "bare.yaml: has neither a spec nor fields; give the full field of view in deg"),
    (("show", "glass.zmx"), "glass.zmx, line 77: GLAS: unknown glass 'NOSUCH' in the built-in plastics and the catal"),
    (("show", SAME, "--catalogue", "absent.agf"), "absent.agf: no such file or directory"),
    (("show", "text.zmx"), "text.zmx, line 1: hello: unknown keyword (with ''), which may change rays; delete"),
    (("show", DOUBLET, "--focus", "nan"), "focus nan (--focus): expected micrometres, such as -10, or file, mtf or"),
    (("show", SAME, "--wavelengths", "2.4,0.6,0.5"), "COC: wavelength 2.4 um is outside the fitted range 0.334 to"),
    (("show", PHONE, "--wavelengths", "0.5,red"), "wavelengths_um: expected a number, found 'red'"),
    (("show", DOUBLET, "--configuration", "2"), "expected a configuration 1 .. 1, got 2 (--configuration)"),
    (("simulate", DOUBLET, "small.png", *OUT), "an image of 30 x 20 pixels is too small for PSFs of 51 pixels: ta"),
    (("simulate", DOUBLET, "image.png", *OUT, "--field", "9,9"), "field (9, 9) mm: outside the field, which ends 2.0"),
    (("simulate", DOUBLET, "image.png", *OUT, "--field", "rim"), "--field rim: expected axis, middle, corner, or"),
]


@pytest.mark.parametrize("arguments, words", MISTAKES, ids=[" ".join(map(str, a[:2])) + w[:12] for a, w in MISTAKES])
def test_a_mistake_is_one_line_and_exit_status_2(folder, capsys, arguments, words):
    """The line says what is wrong, where, and what to do; the command prints and writes nothing else."""
    bad_lenses(folder)
    before = sorted(folder.iterdir())
    assert run(*arguments) == 2
    output = capsys.readouterr()
    (line,) = [line for line in output.err.splitlines() if "no pixels in the file" not in line]
    assert line.startswith("tasklens: ") and words in line
    assert output.out == "" and sorted(folder.iterdir()) == before


def test_a_wrong_option_or_command(capsys):
    """Exit status 2, and what was meant."""
    assert run("shaw", DOUBLET) == 2 and "'show'" in capsys.readouterr().err
    assert run("show", DOUBLET, "--f-nunber", "3") == 2 and "--f-number" in capsys.readouterr().err
    assert run("draw", DOUBLET) == 2 and "--output" in capsys.readouterr().err
    for command, option, value in (("simulate", "--full-well", "nan"), ("tolerance", "--seed", 2**64)):
        assert run(command, DOUBLET, option, value) == 2 and f"'{option}'" in capsys.readouterr().err


def test_an_export_for_zemax_spares_a_catalogue_of_the_same_name(folder, capsys):
    """A plastic unknown to OpticStudio goes into a catalogue beside the lens; the command reports the catalogue."""
    mine = folder / "out.agf"
    mine.write_text("mine")
    assert run("export", DOUBLET, "-o", "out.zmx") == 2
    assert "out.agf: already exists" in capsys.readouterr().err and mine.read_text() == "mine"
    with pytest.raises(InputError, match=r"out\.agf: already exists, and is not ours; choose another name"):
        tasklens.save_lens("out.zmx", *tasklens.load_lens(DOUBLET))
    assert not (folder / "out.zmx").exists()
    assert run("export", DOUBLET, "-o", "out.zmx", "--force") == 0
    tasklens.save_lens("out.zmx", *tasklens.load_lens(DOUBLET))  # the catalogue is now ours
    messages = capsys.readouterr().err
    assert "out.agf with OKP4" in messages and "Glasscat" in messages and "OKP4" in mine.read_text()
