"""`tasklens lens ...` as a user types it, on our lenses and on Zemax files: its output and its error messages."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy
import pytest
import torch
import yaml
from PIL import Image

import tasklens
from tasklens.cli.app import main
from tasklens.optics.io import lens_files, prescription
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import read_tensors

REPOSITORY = Path(__file__).parents[1]
PUBLISHED = REPOSITORY / "docs" / "results" / "headline" / "lenses"
DOUBLET, SAME = PUBLISHED / "doublet-imaging2.yaml", PUBLISHED / "doublet-imaging2.zmx"
PHONE = REPOSITORY / "tests" / "data" / "lenses" / "cellphone" / "source" / "US-9897779-B2-e1.zmx"
FEW = ("--rays", "64")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder with an image of random colours."""
    monkeypatch.chdir(tmp_path)
    values = numpy.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=numpy.uint8)
    Image.fromarray(values).save("image.png")
    return tmp_path


def run(*arguments) -> int:
    return main(["lens", *map(str, arguments)])


def output_of(capsys, *arguments) -> str:
    """What a command that succeeds prints on standard output."""
    assert run(*arguments) == 0
    return capsys.readouterr().out


def json_of(capsys, *arguments) -> dict:
    """The JSON that a command prints; NaN and Infinity, which JSON does not have, are refused."""
    return json.loads(output_of(capsys, *arguments, "--json"), parse_constant=lambda name: pytest.fail(name))


# ---- figures


def test_show_says_what_a_lens_file_says_of_itself(capsys):
    figures = yaml.safe_load(DOUBLET.read_text())["figures"]
    output = json_of(capsys, "show", DOUBLET, "--rays", figures["rays"])[str(DOUBLET)]
    order = sorted(range(9), key=lambda field: figures["angle_deg"][field])
    for key, values in output["fields"].items():
        expected = [figures[key][order[k]] for k in (0, 4, 8)]
        assert values == pytest.approx(expected, rel=1e-9, abs=1e-9), key
    assert "core_radius_um" in output["fields"] and output["materials"] == ["COC", "OKP4"]
    text = output_of(capsys, "show", DOUBLET, "--rays", figures["rays"])
    assert text.startswith(f"{DOUBLET}: 2 elements, COC, OKP4\n") and f"{figures['efl_mm']:.3f} mm" in text
    core, eighty = (line for line in text.splitlines() if "% of the light" in line)
    assert f"{figures['core_radius_um'][order[8]]:.2f}" in core
    assert f"{figures['radius_80_um'][order[8]]:.2f}" in eighty


def test_a_zemax_file_of_our_lens_has_its_figures(capsys):
    """Fields are angles; the file has no pixels, so the command takes those of a study and reports it."""
    assert run("show", DOUBLET, SAME, *FEW, "--json") == 0
    output = capsys.readouterr()
    ours, theirs = json.loads(output.out).values()
    assert f"{SAME}: no pixels in the file: using 1.8 um, and PSF windows of 51" in output.err
    for key in ("efl_mm", "f_number", "track_mm"):
        assert theirs[key] == pytest.approx(ours[key], rel=1e-6)
    for key in ("angle_deg", "rms_centroid_um", "core_radius_um", "mtf_sagittal_half_nyquist"):
        assert theirs["fields"][key] == pytest.approx(ours["fields"][key], rel=1e-3, abs=1e-3), key


def test_the_fields_of_a_file_are_its_own(folder, capsys):
    """Angles on both axes; the nine of the sensor on request, or with another field of view."""
    points = ((0.0, 0.0), (0.0, 10.0), (-12.0, 16.0))
    source = prescription.read(DOUBLET)[0]
    prescription.write(folder / "own.yaml", replace(source, fields=("angle_deg", points)), {})
    own = json_of(capsys, "analyse", "own.yaml", *FEW)
    tangents = [[math.tan(math.radians(angle)) for angle in point] for point in points]
    assert numpy.array(own["fields_mm"]) / own["efl_mm"] == pytest.approx(numpy.array(tangents), rel=1e-9)
    (shown,) = json_of(capsys, "show", "own.yaml", *FEW).values()
    assert shown["fields"]["angle_deg"] == own["angle_deg"] and own["angle_deg"][1] == pytest.approx(10)
    nine = json_of(capsys, "analyse", "own.yaml", *FEW, "--sensor-fields")
    assert len(nine["fields_mm"]) == 9 and max(nine["angle_deg"]) == pytest.approx(max(own["angle_deg"]))
    assert len(json_of(capsys, "analyse", "own.yaml", *FEW, "--field-of-view", 30)["fields_mm"]) == 9


def test_options_are_in_place_of_the_files_specification(capsys):
    """A stop of half the diameter: twice the F-number, an Airy disc of twice the radius, a smaller spot on the axis."""
    (open_,) = json_of(capsys, "show", DOUBLET, *FEW).values()
    (closed,) = json_of(capsys, "show", DOUBLET, *FEW, "--f-number", 2 * open_["f_number"]).values()
    assert closed["f_number"] == pytest.approx(2 * open_["f_number"], rel=1e-6)
    assert closed["airy_radius_um"] == pytest.approx(2 * open_["airy_radius_um"], rel=1e-6)
    assert closed["fields"]["rms_centroid_um"][0] < open_["fields"]["rms_centroid_um"][0]
    (narrow,) = json_of(capsys, "show", PHONE, *FEW, "--field-of-view", "20").values()
    assert narrow["fields"]["angle_deg"][-1] == pytest.approx(10, abs=1e-9)


def test_python_focuses_as_the_command_does(capsys):
    own, _ = tasklens.load_lens(DOUBLET)
    own_distance = json_of(capsys, "analyse", DOUBLET, *FEW)["image_distance_mm"]
    for focus in ("file", "mtf", "spot", -12.5):
        shift = float(tasklens.load_lens(DOUBLET, focus=focus)[0].thickness[-1] - own.thickness[-1])
        distance = json_of(capsys, "analyse", DOUBLET, *FEW, "--focus", focus)["image_distance_mm"]
        assert distance - own_distance == pytest.approx(shift, abs=1e-12)
        assert (shift == 0) == (focus == "file") and (shift == pytest.approx(-0.0125)) == (focus == -12.5)


def test_another_object_distance_refocuses(capsys):
    """To the peak of the MTF, with a remark; the image plane of the file on request."""
    distances = {}
    for focus in (None, "mtf", "file"):
        words = ("--object-distance", "100", *(() if focus is None else ("--focus", focus)))
        assert run("analyse", DOUBLET, *FEW, *words, "--json") == 0
        output = capsys.readouterr()
        assert ("object at infinity in the file: refocused for 100 mm: image plane " in output.err) == (focus != "file")
        distances[focus] = json.loads(output.out)["image_distance_mm"]
    own = json_of(capsys, "analyse", DOUBLET, *FEW)
    assert distances[None] == pytest.approx(distances["mtf"], abs=1e-6)
    assert distances["file"] == pytest.approx(own["image_distance_mm"], abs=1e-12)


def test_a_shifted_image_plane(capsys):
    """Foci stay where they are, within 1e-6 um; spots are smaller in the plane of the best spot."""
    analyses = {shift: json_of(capsys, "analyse", PHONE, *FEW, "--focus", shift) for shift in (0.0, 20.0)}
    assert analyses[0.0] == json_of(capsys, "analyse", PHONE, *FEW)
    for shift in analyses:
        distance = analyses[0.0]["image_distance_mm"] + 1e-3 * shift
        assert analyses[shift]["image_distance_mm"] == pytest.approx(distance, rel=0, abs=1e-9)
        assert analyses[shift]["efl_mm"] == analyses[0.0]["efl_mm"]
        for name in ("focus_tangential_um", "focus_sagittal_um"):
            expected = numpy.array(analyses[0.0][name]) - shift
            assert numpy.array(analyses[shift][name]) == pytest.approx(expected, rel=0, abs=1e-6)
    best, near = (json_of(capsys, "analyse", PHONE, *FEW, "--focus", shift) for shift in ("spot", 5))
    assert sum(best["rms_centroid_um"]) < sum(near["rms_centroid_um"])
    (output,) = json_of(capsys, "show", PHONE, *FEW, "--focus", 20).values()
    assert output["fields"]["rms_centroid_um"][0] == pytest.approx(analyses[20.0]["rms_centroid_um"][0], rel=1e-12)


def test_compare_fits_a_terminal(capsys):
    """Lenses of a study fit into 120 columns, named without folders."""
    files = [PUBLISHED / f"{name}.yaml" for name in ("quadruplet-image_contrast", "doublet-tasklens_joint")]
    rows = json_of(capsys, "compare", *files, *FEW)
    text = output_of(capsys, "compare", *files, *FEW)
    assert max(map(len, text.splitlines())) <= 120
    for path, row, line in zip(files, rows, text.splitlines()[1:3], strict=True):
        assert row["lens"] == str(path)
        cells = [path.stem, f"{row['rms_spot_um']:.2f}", f"{row['core_radius_um']:.2f}"]
        assert set(cells) <= set(line.split())
        assert row["core_radius_um"] < row["radius_80_um"]
        assert row["worst_margin"] == yaml.safe_load(path.read_text())["worst_margin"]


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


def test_analyse_lists_the_margins_of_a_design(capsys):
    """Of the lens as in the file; margins with another field of view, focus or F-number are not known."""
    assert "max slope |" in output_of(capsys, "analyse", DOUBLET, *FEW)
    assert min(json_of(capsys, "analyse", DOUBLET, *FEW)["margins"].values()) >= 0
    assert "max slope" not in output_of(capsys, "analyse", DOUBLET, *FEW, "--focus", 10)
    assert "worst margin" in output_of(capsys, "show", DOUBLET, *FEW)
    for option in (("--field-of-view", "60"), ("--f-number", "3.2")):
        assert "margin" not in output_of(capsys, "show", DOUBLET, *option, *FEW)


def test_analyse_has_the_seidel_sums_by_surface(capsys):
    analysis = json_of(capsys, "analyse", PHONE, *FEW)
    for name, total in analysis["seidel_um"].items():
        assert sum(analysis["seidel_by_surface_um"][name]) == pytest.approx(total, rel=1e-9, abs=1e-9)
    text = output_of(capsys, "analyse", PHONE, *FEW)
    assert text.startswith(f"# {PHONE}") and f"{analysis['efl_mm']:.4f}" in text and "EE50 [um]" in text
    assert max(map(len, text.splitlines())) <= 120


# ---- files


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
    with Image.open("psf.png") as image:  # the brightest pixel of each PSF is white in one colour
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


SIMULATE = ("-o", "capture.png", *FEW)
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
    (
        ("simulate", DOUBLET, "small.png", *SIMULATE),
        "an image of 30 x 20 pixels is too small for PSFs of 51 pixels: ta",
    ),
    (("simulate", DOUBLET, "image.png", *SIMULATE, "--field", "9,9"), "--field 9,9: outside the field, which ends 2.0"),
    (("simulate", DOUBLET, "image.png", *SIMULATE, "--field", "rim"), "--field rim: expected axis, middle, corner, or"),
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
