"""Lens files: lossless and self-contained. Refusals of wrong values: `lenses` of bad_inputs.yaml."""

import math
from dataclasses import replace

import pytest
import yaml
from examples import make_lens, random_lens
from prescriptions import random_prescription, same_bits

from tasklens.materials.material import AIR, Material
from tasklens.optics.io import lens_files, prescription
from tasklens.optics.io.prescription import Prescription
from tasklens.runtime.files import FileError
from tasklens.study.report.measurements import Measurements


@pytest.mark.parametrize("seed", range(6))
def test_round_trip_keeps_every_bit(tmp_path, seed):
    original, path = random_prescription(seed), tmp_path / "lens.yaml"
    prescription.write(path, original, {"origin": {"seed": seed}})
    restored, content = prescription.read(path)
    assert same_bits(restored.lens, original.lens)
    assert replace(restored, lens=None) == replace(original, lens=None)
    assert content["origin"] == {"seed": seed}
    assert yaml.safe_load(path.read_text(encoding="utf-8")) == content


def test_round_trip_of_a_design(tmp_path):
    """Denormals, negative zero and infinite apertures too; unknown data about the use of a lens stays unknown."""
    lens = random_lens(0)
    lens.semi_diameter[1:] = lens.semi_diameter.new_tensor([1 / 3, math.pi, 1e-17, math.inf])
    lens.alpha[1] = lens.alpha.new_tensor([5e-324, -0.0, 1e22, 1e-7, 0.1 + 0.2])
    prescription.write(tmp_path / "lens.yaml", Prescription(lens), {})
    restored, _ = prescription.read(tmp_path / "lens.yaml")
    assert same_bits(restored.lens, lens)
    assert replace(restored, lens=None) == Prescription(None)


def test_a_file_holds_the_dispersion_of_its_materials(tmp_path):
    """The file reads back without the plastic's catalogue, and an edited coefficient takes effect."""
    mine = Material("MINE", "conrady", (1.5, 0.01, 0.002), (0.4, 0.8), "measured")
    content = prescription.to_dict(Prescription(make_lens([0.5, 0.1], [1.0, 2.0], (mine, "air"))))
    assert content["materials"] == {"MINE": mine.definition()}
    content["materials"]["MINE"]["coefficients"][0] = 1.6
    assert prescription.from_dict(content).lens.media[0].refractive_index(0.5) == pytest.approx(
        mine.refractive_index(0.5) + 0.1, rel=1e-15
    )


def test_two_materials_of_one_name_cannot_be_written():
    first, second = (Material("X", "conrady", (n, 0.0, 0.0), (0.4, 0.8)) for n in (1.5, 1.6))
    for media in ((first, second), (replace(first, name="air"), AIR)):
        with pytest.raises(FileError, match="rename"):
            prescription.to_dict(Prescription(make_lens([0.0, 0.0], [1.0, 1.0], media)))


@pytest.mark.parametrize("text", ["", "3", "- 1", "a: [1", "format: 2", "\x00"])
def test_what_is_no_lens_file_is_refused(tmp_path, text):
    (tmp_path / "lens.yaml").write_text(text)
    with pytest.raises(FileError, match=r"lens\.yaml"):
        prescription.read(tmp_path / "lens.yaml")


def test_numbers_as_people_write_them():
    """1e-3, which YAML reads as text, and integers."""
    content = prescription.to_dict(Prescription(random_lens(0)))
    content["surfaces"][2]["thickness"] = "1e-3"
    content["surfaces"][1]["curvature"] = 1
    lens = prescription.from_dict(content).lens
    assert float(lens.thickness[2]) == 1e-3 and float(lens.curvature[1]) == 1.0


def test_missing_orders_are_zero():
    """A file may leave out alpha_2j of single surfaces."""
    content = prescription.to_dict(Prescription(random_lens(0)))
    for key in ("alpha_4", "alpha_10"):
        del content["surfaces"][1][key]
    alpha = prescription.from_dict(content).lens.alpha
    assert alpha.shape == (5, 5)
    assert alpha[1, 1] == alpha[1, 4] == 0 and (alpha[2] != 0).all()


def test_a_lens_with_inconsistent_shapes_is_refused():
    with pytest.raises(ValueError, match="thickness"):
        make_lens([0.0, 0.0], [1.0], ("COC", "air"))


def test_figures_are_of_the_prescription_beside_them(tmp_path):
    """A thickness edited under old figures is refused when these are read; the lens itself can still be read."""
    path = tmp_path / "lens.yaml"
    prescription.write(path, Prescription(random_lens(1)), {"figures": {"efl_mm": 3.0}})
    measured = Measurements({("a", 0): path}, {})
    assert measured.lens_file("a", 0)["figures"] == {"efl_mm": 3.0}
    content = yaml.safe_load(path.read_text())
    content["surfaces"][1]["thickness"] += 1e-6
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(FileError, match=r"lens\.yaml: its prescription was changed after its figures"):
        measured.lens_file("a", 0)
    source, rest = lens_files.read_prescription(path)
    assert float(source.lens.thickness[1]) == content["surfaces"][1]["thickness"] and "figures" not in rest
    assert source.remarks == ("the lens was changed after its figures and margins were computed, so they are left out",)
