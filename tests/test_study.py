"""The study's configuration: accepted values, refused values and their messages."""

import itertools
import math
import re

import jsonschema
import pytest
import yaml
from examples import write
from studies import changed, studies_we_ship, tiny_study, with_imported

from tasklens.materials.catalogues import PLASTICS, builtin
from tasklens.settings.design_settings import LearningRates
from tasklens.settings.specification import Spec
from tasklens.study.claims import OVER_END_TO_END, claims
from tasklens.study.loading import dump, load, parse, read, with_base_study, without_null
from tasklens.study.schema import schema
from tasklens.study.study import StudyError
from tasklens.study.table_contents import starts

STUDIES = studies_we_ship()


@pytest.mark.parametrize("section", ["format", "images", "supervisor"])
def test_a_missing_section_is_named(section):
    study = tiny_study()
    del study[section]
    with pytest.raises(StudyError, match=rf"^{section}: missing"):
        parse(study)


@pytest.mark.parametrize(
    "start, others, words",
    [
        ("best_imaging", (), "needs a design by spot or least squares or image quality"),
        ("best_spot", ("image_error",), "needs a design by spot or least squares"),
    ],
)
def test_the_best_imaging_lens_needs_an_imaging_design(start, others, words):
    study = tiny_study()
    together = study["designs"]["end_to_end_from_imaging"] | {"start": start}
    study["designs"] = {name: study["designs"][name] | {"start": "flat"} for name in others} | {"e2e": together}
    with pytest.raises(StudyError, match=rf"designs\.e2e\.start: .*{words}$"):
        parse(study)


def test_best_spot_is_the_best_of_lenses_by_spots():
    """Not of those for image quality, which best_imaging includes; the claim about end-to-end designs is of both."""
    study = tiny_study()
    study["designs"]["end_to_end_from_spot"] = study["designs"]["end_to_end_from_imaging"] | {"start": "best_spot"}
    study = parse(study)
    spots = {"singlet-imaging1", "singlet-imaging2"} & {*study.lenses}
    assert {*starts(study, "singlet-end_to_end_from_spot")} == spots
    assert {*starts(study, "singlet-end_to_end_from_imaging")} == spots | {"singlet-image_error"}
    compared = {claim.baselines for claim in claims(study).claims if claim.text == OVER_END_TO_END}
    assert compared == {("singlet-end_to_end_from_spot",), ("singlet-end_to_end_from_imaging",)}


def test_yaml_reads_1e_4_as_text_and_the_study_as_a_number(tmp_path):
    """YAML 1.1 wants 1.0e-4; numbers are accepted as people write them."""
    text = yaml.safe_dump(changed(tiny_study(), "fine_tuning.learning_rate", 1))
    text = text.replace("learning_rate: 1\n", "learning_rate: 1e-4\n")
    assert isinstance(yaml.safe_load(text)["fine_tuning"]["learning_rate"], str)
    (tmp_path / "study.yaml").write_text(text)
    assert load(tmp_path / "study.yaml").fine_tuning.learning_rate == 1e-4


def test_rates_have_presets():
    """The paper's (section 3.3) and ours, under their names; a study file may also spell them out."""

    def rates(value) -> LearningRates:
        study = parse(changed(tiny_study(), "designs.imaging1.descents.0.learning_rates", value))
        return study.designs["imaging1"].descents[0].learning_rates

    preset = rates("paper")
    assert (preset.curvature, preset.thickness, preset.alpha_4, preset.decay) == (1e-4, 1e-4, 1e-4, 0.02)
    assert not preset.normalised
    assert rates(preset.model_dump()) == preset != rates("ours")


@pytest.mark.parametrize("name", STUDIES)
def test_the_studies_we_ship_can_be_read(name):
    """The command in their heading runs them; each is in the file of its name, the default study in config.yaml."""
    study = load(STUDIES[name])
    assert study.name == {"config.yaml": "small"}.get(name, STUDIES[name].stem)
    assert study.lenses and study.supervisor in study.classifiers
    file = "" if name == "config.yaml" else f" --config study={study.name}"
    commands = [line for line in STUDIES[name].read_text().splitlines() if line.startswith("#   snakemake")]
    assert commands and all(re.split(" {3,}", line)[1].endswith(file) for line in commands)


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(schema())


@pytest.mark.parametrize("name", STUDIES)
def test_editors_find_no_mistake_in_the_studies_we_ship(name, validator):
    """By the schema: the files of config/, with parts of a study and null entries, and the studies that they mean."""
    content = read(STUDIES[name])
    validator.validate(content)
    validator.validate(without_null(with_base_study(content, STUDIES[name].parent)))


def test_editors_find_mistakes(validator):
    """In a whole study, and in one that extends another."""
    for study in map(read, (STUDIES["config.yaml"], STUDIES["doublets.yaml"])):
        assert not validator.is_valid(study | {"tolerances": {"grade": "by hand"}})
        assert not validator.is_valid(study | {"images": {"sise": 64}})


def test_a_study_extends_another_one(here):
    """By its name: in the folder of its file, in `config`, among those that we ship. The file wins, key by key."""
    study = changed(tiny_study(), "elements.doublet", ["COC", "OKP4"])
    write(here / "own" / "base.yaml", yaml.safe_dump(study | {"name": "base"}))
    write(here / "own" / "middle.yaml", "{name: middle, extends: base, seeds: [3], elements: {doublet: null}}")
    top = "{name: top, extends: middle, designs: {tasklens: {descents: {1: {steps: 7}}}}}"
    write(here / "own" / "any.yaml", top)
    top_study = load(here / "own" / "any.yaml")
    assert (top_study.name, top_study.seeds, set(top_study.elements)) == ("top", (3,), {"singlet"})
    assert [descent.steps for descent in top_study.designs["tasklens"].descents] == [2, 7, 1, 1]
    assert load(*(here / "own" / f"{name}.yaml" for name in ("base", "middle", "any"))) == top_study
    (here / "own").rename(here / "config")
    assert parse(yaml.safe_load(top)) == top_study
    assert parse({"name": "mine", "extends": "smoke"}).designs == load(STUDIES["smoke.yaml"]).designs


def test_a_study_that_extends_another_has_a_name_of_its_own():
    """Otherwise its results would be in the folder of the other one."""
    with pytest.raises(StudyError, match="name: missing"):
        parse({"extends": "smoke", "seeds": [3]})


@pytest.mark.parametrize(
    "extends, words",
    [
        ("absent", r"absent\.yaml: no such study in .* expected one of .*headline"),
        ("mine", "extends: mine extends mine; expected a study that does not extend itself"),
        ([1], r"extends = \[1\]: expected the name of a study"),
    ],
)
def test_a_study_that_extends_nothing_is_refused(tmp_path, extends, words):
    write(tmp_path / "mine.yaml", yaml.safe_dump({"name": "mine", "extends": extends}))
    with pytest.raises(StudyError, match=words):
        load(tmp_path / "mine.yaml")


def test_null_in_a_study_that_extends_another_removes_an_entry(tmp_path):
    """Of the sections with names, as in RFC 7386; alone, null is a mistake like any other."""
    study = changed(tiny_study(), "elements.doublet", ["COC", "OKP4"])
    study = changed(study, "designs.tasklens.grade", "phone_moulding")
    below, above = tmp_path / "below.yaml", tmp_path / "above.yaml"
    write(below, yaml.safe_dump(study))
    write(above, "{name: above, elements: {singlet: null}, designs: {imaging1: null, tasklens: {grade: null}}}")
    merged = load(below, above)
    assert set(merged.lenses) == {f"doublet-{name}" for name in study["designs"] if name != "imaging1"}
    assert merged.designs["tasklens"].grade is None
    write(below, yaml.safe_dump(changed(study, "designs.imaging1", None)))
    with pytest.raises(StudyError, match=r"designs\.imaging1 = null: expected keys and values"):
        load(below)


def test_a_psf_window_fits_into_the_images_of_tasks():
    """Half of the window is reflected at the borders, as for the images of classification."""
    training = {"epochs": 1, "learning_rate": 1}
    network = {"kind": "segmentation", "model": "lraspp_mobilenet_v3_large", "training": training}
    tasks = {"scenes": {"size": 64}, "networks": {"pixels": network | {"fine_tuning": training}}}
    study = changed(changed(tiny_study(), "images.size", 64), "spec.kernel_size", 101) | {"tasks": tasks}
    assert parse(study)
    with pytest.raises(StudyError, match=r"spec\.kernel_size: half of 101 must be less than tasks\.scenes\.size = 32"):
        parse(changed(study, "tasks.scenes.size", 32))


def test_the_resolved_study_is_the_same_study(tmp_path):
    """The file for the jobs has every default; an imported lens is the last one, of elements that need not exist."""
    study = parse(with_imported(catalogues=[str(PLASTICS)]))
    assert list(study.lenses) == [*parse(tiny_study()).lenses, "quadruplet-phone"]
    assert study.lens("quadruplet-phone").elements == "quadruplet" and "quadruplet" not in study.elements
    (tmp_path / "study.yaml").write_text(dump(study))
    assert load(tmp_path / "study.yaml") == study
    assert "evaluation_rays" in dump(study) and "max_slope" in dump(study)


def test_specification_of_the_paper():
    """EFL = 2 mm / tan 34.4 deg, stop EFL / 5.6, fields over a quarter of a 16:9 sensor of 4 mm diagonal."""
    spec = Spec()
    assert spec.efl_mm == pytest.approx(2.921, abs=5e-4)
    assert spec.stop_radius_mm == pytest.approx(0.52, abs=2e-3)
    assert len(set(spec.fields_mm)) == 9
    heights = [math.hypot(*field) for field in spec.fields_mm]
    assert min(heights) == 0 and max(heights) == pytest.approx(2.0, rel=1e-15)
    width, height = spec.fields_mm[-1]
    assert width / height == pytest.approx(16 / 9, rel=1e-15)
    assert spec.fields_mm[4] == (width / 2, height / 2)


def test_lenses_are_every_element_choice_with_every_design():
    study = parse(changed(tiny_study(), "elements.doublet", ["COC", "OKP4"]))
    expected = {f"{e}-{d}" for e, d in itertools.product(["singlet", "doublet"], tiny_study()["designs"])}
    assert set(study.lenses) == expected
    assert study.lens("doublet-imaging1").plastics == (builtin("COC"), builtin("OKP4"))


MINE = builtin("COC").definition() | {"coefficients": [2.3, 0.01, 0.037, 0, 0, 0], "range_um": [0.45, 0.7]}


def test_plastics_come_from_the_users_files(tmp_path):
    """YAML and AGF, a new name and a built-in one; the resolved study needs the files no more."""
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"MINE": MINE}))
    (tmp_path / "maker.agf").write_text("NM COC 5 0 1.5 50\nCD 1.5 0.01 0.002\nLD 0.45 0.7\n")
    study = changed(tiny_study(), "elements", {"doublet": ["MINE", "COC"], "singlet": ["PMMA"]})
    study = parse(study | {"materials": [str(tmp_path / name) for name in ("mine.yaml", "maker.agf")]})
    mine, coc = study.lens("doublet-imaging1").plastics
    assert mine.definition() == MINE and coc.formula == "conrady"
    assert set(study.materials) == {"MINE", "COC", "PMMA"}
    for name in ("mine.yaml", "maker.agf"):
        (tmp_path / name).unlink()
    (tmp_path / "study.yaml").write_text(dump(study))
    assert load(tmp_path / "study.yaml") == study


def test_a_wavelength_outside_a_used_plastics_range_is_named():
    study = changed(tiny_study(), "elements.singlet", ["MINE"]) | {"materials": {"MINE": MINE}}
    with pytest.raises(StudyError, match=r"0\.72.*0\.45 to 0\.7.*MINE"):
        parse(changed(study, "spec.wavelengths_um", [0.72, 0.6, 0.5]))


def test_yaml_with_anchors_and_merged_keys_is_read(tmp_path):
    """A key may change what `<<` brings; 0, 10 and quoted numbers are what they seem."""
    text = "a: &a {steps: 10, seed: 0}\nb: {<<: *a, steps: 2}\nc: ['05', *a, *a]\n"
    write(tmp_path / "study.yaml", text)
    assert read(tmp_path / "study.yaml")["b"] == {"steps": 2, "seed": 0}
