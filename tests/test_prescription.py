"""Lens files: lossless, self-contained, and plain about what is wrong with them."""

import copy
import math
from dataclasses import replace

import pytest
import yaml
from examples import make_lens, random_lens
from prescriptions import random_prescription, same_bits

from tasklens.materials.material import AIR, Material
from tasklens.optics.io import prescription
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


def broken_content(change) -> dict:
    content = copy.deepcopy(prescription.to_dict(replace(random_prescription(6), lens=random_lens(0), comments=None)))
    change(content)
    return content


def put(*keys, value):
    """A change that puts a value at a path of keys."""

    def change(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value
        if value is ...:
            del content[keys[-1]]

    return change


def drop(*keys):
    return put(*keys, value=...)


NUMBERS = ("curvature", "conic", "thickness", "semi_diameter")
MISTAKES = [
    (put("format", value=1), ["format 1", "expected 2"]),
    (drop("format"), ["format None"]),
    (put("units", value="inch"), ["units", "inch", "mm"]),
    *((drop(key), [f"no {key}"]) for key in ("surfaces", "materials", "stop")),
    (put("surfaces", value=[]), ["surfaces", "at least one"]),
    (put("surfaces", value={"0": {}}), ["surfaces", "list"]),
    (put("surfaces", 2, value=None), ["surface 2", "None"]),
    *((drop("surfaces", 2, key), ["surface 2", key]) for key in (*NUMBERS, "medium")),
    *((put("surfaces", 3, key, value="1.2.3"), ["surface 3", key, "1.2.3"]) for key in (*NUMBERS, "alpha_4")),
    *(
        (put("surfaces", 3, "thickness", value=value), ["surface 3", "thickness", str(value)])
        for value in (math.nan, -math.inf, True, [1.0], "1_0", "1e999", "ten", None)
    ),
    (put("surfaces", 3, "semi_diameter", value=-1.0), ["surface 3", "semi_diameter", "-1.0"]),
    *((put("surfaces", 0, "semi_diameter", value=v), ["surface 0", "stop", "positive", str(v)]) for v in (0, 0.0)),
    *((put("surfaces", 1, k, value=3.0), ["surface 1", k]) for k in ("radius", "alpha_5", "alpha_04", "alpha_482")),
    (put("surfaces", 1, "medium", value="GLASS"), ["surface 1", "GLASS", "COC"]),
    (put("materials", value=["COC"]), ["materials", "COC"]),
    (put("materials", "COC", "formula", value="magic"), ["materials", "COC", "magic"]),
    *((put("stop", value=value), ["stop", str(value)]) for value in (5, -1, 1.5, "1", None, True)),
    (put("aperture", value=2.8), ["aperture", "2.8"]),
    (put("aperture", value={"speed": 2.8}), ["aperture", "speed", "f_number"]),
    (put("fields", value={"angle_deg": [[0, 1], [3]]}), ["fields", "[3]"]),
    (put("fields", value={"angle_deg": [[0, "x"]]}), ["fields", "x"]),
    *((put("aperture", value={"f_number": v}), ["aperture: f_number", "positive", str(v)]) for v in (0, -2.8)),
    *((put("wavelengths_um", value=[v, 0.5, 0.6]), ["wavelengths_um", "positive", str(v)]) for v in (0, -0.5)),
    (put("wavelengths_um", value=0.5), ["wavelengths_um", "0.5"]),
    (put("primary", value=3), ["primary", "3"]),
    (drop("primary"), ["primary"]),
    *((put("object_distance_mm", value=v), ["object_distance_mm", str(v)]) for v in ("near", 0, -370.0, math.inf)),
]


@pytest.mark.parametrize("change, words", MISTAKES)
def test_a_wrong_file_is_refused_with_the_reason(change, words):
    with pytest.raises(FileError) as error:
        prescription.from_dict(broken_content(change), "my.yaml")
    assert all(word in str(error.value) for word in ["my.yaml", *words]), error.value


@pytest.mark.parametrize("text", ["", "3", "- 1", "a: [1", "format: 2", "\x00"])
def test_what_is_no_lens_file_is_refused(tmp_path, text):
    (tmp_path / "lens.yaml").write_text(text)
    with pytest.raises(FileError, match=r"lens\.yaml"):
        prescription.read(tmp_path / "lens.yaml")


def test_numbers_as_people_write_them():
    """1e-3, which YAML reads as text, and integers."""
    content = broken_content(put("surfaces", 2, "thickness", value="1e-3"))
    content["surfaces"][1]["curvature"] = 1
    lens = prescription.from_dict(content).lens
    assert float(lens.thickness[2]) == 1e-3 and float(lens.curvature[1]) == 1.0


def test_missing_orders_are_zero():
    """A file may leave out alpha_2j of single surfaces."""
    content = broken_content(lambda c: [c["surfaces"][1].pop(f"alpha_{k}") for k in (4, 10)])
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
    assert float(prescription.read(path)[0].lens.thickness[1]) == content["surfaces"][1]["thickness"]
