"""`tasklens lens ...` as a user types it, on our lenses and on Zemax files: the figures that it prints."""

import json
import math
from dataclasses import replace

import numpy
import pytest
import yaml
from lens_command import DOUBLET, FEW, PHONE, SAME, json_of, output_of, run

import tasklens
from tasklens.optics.io import prescription


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


def test_the_fields_of_a_file_are_its_own(tmp_path, capsys):
    """Angles on both axes; the nine of the sensor on request, or with another field of view."""
    points = ((0.0, 0.0), (0.0, 10.0), (-12.0, 16.0))
    source, path = prescription.read(DOUBLET)[0], tmp_path / "own.yaml"
    prescription.write(path, replace(source, fields=("angle_deg", points)), {})
    own = json_of(capsys, "analyse", path, *FEW)
    tangents = [[math.tan(math.radians(angle)) for angle in point] for point in points]
    assert numpy.array(own["fields_mm"]) / own["efl_mm"] == pytest.approx(numpy.array(tangents), rel=1e-9)
    (shown,) = json_of(capsys, "show", path, *FEW).values()
    assert shown["fields"]["angle_deg"] == own["angle_deg"] and own["angle_deg"][1] == pytest.approx(10)
    nine = json_of(capsys, "analyse", path, *FEW, "--sensor-fields")
    assert len(nine["fields_mm"]) == 9 and max(nine["angle_deg"]) == pytest.approx(max(own["angle_deg"]))
    assert len(json_of(capsys, "analyse", path, *FEW, "--field-of-view", 30)["fields_mm"]) == 9


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
    files = [DOUBLET.with_name(f"{name}.yaml") for name in ("quadruplet-image_contrast", "doublet-tasklens_joint")]
    rows = json_of(capsys, "compare", *files, *FEW)
    text = output_of(capsys, "compare", *files, *FEW)
    assert max(map(len, text.splitlines())) <= 120
    for path, row, line in zip(files, rows, text.splitlines()[1:3], strict=True):
        assert row["lens"] == str(path)
        assert {path.stem, f"{row['rms_spot_um']:.2f}", f"{row['core_radius_um']:.2f}"} <= set(line.split())
        assert row["core_radius_um"] < row["radius_80_um"]
        assert row["worst_margin"] == yaml.safe_load(path.read_text())["worst_margin"]


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
