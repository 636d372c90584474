"""The study's configuration: what it accepts, and what it refuses and how."""

import itertools
import math
from pathlib import Path

import pytest
import yaml
from examples import changed, tiny_study, with_imported, write

from tasklens.materials.catalogues import PLASTICS, builtin
from tasklens.study.design_settings import LearningRates
from tasklens.study.loading import dump, load, parse, read
from tasklens.study.settings import Spec
from tasklens.study.study import StudyError

CONFIGS = sorted((Path(__file__).parents[1] / "config").glob("*.yaml"))
CONFIGS = [path for path in CONFIGS if "format: 2" in path.read_text()]  # the others are laid over the default study

# key to change, its bad value, words that the message must hold beside the last part of the key
MISTAKES = [
    ("images.sise", 32, ["unknown key"]),
    ("nmae", "x", ["unknown key"]),
    ("name", "My Study", ["My Study"]),
    ("format", 1, ["1", "2"]),
    ("format", 3, ["3", "2"]),
    ("elements.doublet", ["COC", "GLASS"], ["GLASS", "OKP4"]),
    ("elements.doublet", [], ["at least one"]),
    ("materials", ["nowhere.yaml"], ["nowhere.yaml", "No such file"]),
    ("materials", ["lens.txt"], ["lens.txt", "agf"]),
    ("materials", "COC", ["COC", "list of files"]),
    ("materials", {"X": {"formula": "schott"}}, ["X", "coefficients"]),
    ("elements", {}, ["at least 1"]),
    ("spec.kernel_size", 50, ["50", "odd"]),
    ("spec.kernel_size", 1, ["1", "3"]),
    ("spec.kernel_size", 33, ["33", "16"]),
    ("spec.f_number", 0, ["0", "greater than 0"]),
    ("spec.field_of_view_deg", 180, ["180", "150"]),
    ("images.size", 17, ["17", "multiple of 2"]),
    ("images.train", -5, ["-5", "greater than 0"]),
    ("images.train", None, ["train"]),
    ("evaluation_rays", 0, ["0", "greater than 0"]),
    ("seeds", [], ["at least 1"]),
    ("seeds", [-1], ["-1"]),
    ("seeds", "many", ["many"]),
    ("tables", ["table5"], ["table5", "table4"]),
    ("supervisor", "nobody", ["nobody", "small"]),
    ("capture.outside_window", "ignore", ["ignore", "veil", "renormalise"]),
    ("fine_tuning.learning_rate", "fast", ["fast", "number"]),
    ("fine_tuning.warmup", 1.5, ["1.5", "less than or equal to 1"]),
    ("designs.imaging1.method", "magic", ["magic", "spot", "least_squares"]),
    ("designs.imaging1.steps", -1, ["-1", "greater than 0"]),
    ("designs.imaging1.images", 8, ["8", "unknown key"]),
    ("designs.imaging2.highest_order", 5, ["5", "4, 6, 8 or 10"]),
    ("designs.tasklens.finish.size", 4, ["designs.tasklens.finish.size", "4", "spec.kernel_size = 11", "16"]),
    (
        "ablations",
        {"crop": {"elements": "singlet", "design": "tasklens", "variants": {"large": {"restart": {"size": 17}}}}},
        ["ablations.crop.variants.large.restart.size", "images.size = 16"],
    ),
    ("specs", {"singlet": {"kernel_size": 33}}, ["specs.singlet.kernel_size", "images.size = 16"]),
    ("designs.tasklens.refinement.size", 17, ["17", "images.size = 16"]),
    (
        "designs.tasklens.candidates",
        ["end_to_end_from_flat"],
        ["tasklens.candidates", "end_to_end_from_flat", "imaging2"],
    ),
    (
        "designs.joint",
        {"method": "joint_ray_space", "network_learning_rate": 1e-3, "batch_size": 2, "candidates": ["imaging1"]}
        | {key: {"steps": 1, "pixels": [1, 1]} for key in ("restart", "refinement", "finish")},
        ["joint", "candidates", "restart", "not both"],
    ),
    ("designs.tasklens.finish.criterion", "image_error", ["tasklens", "finish.criterion", "classification"]),
    (
        "designs.joint",
        {"method": "joint_ray_space", "network_learning_rate": 1e-3, "batch_size": 8, "candidates": ["imaging1"]}
        | {"finish": {"steps": 1, "pixels": [1, 1]}},
        ["joint", "micro_batch", "72 captures", "batch norms"],
    ),
    ("images.minival", 1, ["images.minival", "2"]),
    ("designs.image_error.candidates", ["imaging1"], ["image_error", "candidates", "finish"]),
    ("designs.image_error.refinement", None, ["image_error", "restart", "refinement", "candidates"]),
    ("images.periods", [8, 4], ["images.periods", "shorter"]),
    ("fine_tuning.epochs", -1, ["fine_tuning.epochs", "-1"]),
    ("designs.imaging1.learning_rates", "theirs", ["theirs", "paper", "ours"]),
    ("designs.end_to_end_from_flat.size", 17, ["17", "images.size = 16"]),
    ("designs.image_error.restart.criterion", "classification", ["restart.criterion", "log_image_error"]),
    ("designs.tasklens.restart.pixels", [1, 20], ["restart.pixels", "coarse"]),
    ("designs.tasklens.restart.pixels", [20, 0.5], ["restart.pixels", "0.5"]),
    ("designs.end_to_end_from_flat.cold_start", {"stop_scale": 2}, ["stop_scale", "2"]),
    ("classifiers.small.training", None, ["pretrained", "weights", "training"]),
    ("classifiers.small.weights", 3, ["3"]),
    ("restored", ["doublet"], ["doublet", "singlet"]),
    ("restoration.decoder", [1, 1], ["encoder", "decoder"]),
    ("constraints.distortion", -0.1, ["-0.1"]),
    ("constraints.flat_track", 0, ["0", "greater than 0"]),
    ("classifiers.small.processes", 3, ["classifiers.small.processes", "fine_tuning.batch_size"]),
    ("imported.phone.file", "nowhere.zmx", ["imported.phone.file", "nowhere.zmx", "expected a file"]),
    ("imported.phone.file", __file__, ["imported.phone.file", ".zmx", ".yaml"]),
    ("imported.phone", {"elements": "x", "file": str(PLASTICS), "catalogues": ["no.agf"]}, ["catalogues", "no.agf"]),
    ("imported.phone", {"elements": "x-y", "file": str(PLASTICS)}, ["elements", "x-y"]),
    ("imported.phone", {"file": str(PLASTICS)}, ["imported.phone.elements", "missing"]),
    ("specs", {"nothing": {"f_number": 2.0}}, ["specs.nothing", "singlet"]),
    ("specs", {"singlet": {"f_numbre": 2.0}}, ["specs.singlet.f_numbre"]),
    ("specs", {"singlet": {"f_number": -2.0}}, ["specs.singlet.f_number", "greater than 0"]),
    ("imported.imaging1", {"elements": "singlet", "file": str(PLASTICS)}, ["designs", "imaging1", "rename"]),
]


@pytest.mark.parametrize("key, value, words", MISTAKES, ids=[f"{k}={v}" for k, v, _ in MISTAKES])
def test_a_mistake_is_named(key, value, words):
    """One StudyError tells the key, the value and what was expected."""
    with pytest.raises(StudyError) as error:
        parse(changed(tiny_study(), key, value))
    message = str(error.value)
    assert all(word in message for word in [key.split(".")[-1], *words]), message


@pytest.mark.parametrize("section", ["format", "name", "images", "elements", "designs", "supervisor", "fine_tuning"])
def test_a_missing_section_is_named(section):
    study = tiny_study()
    del study[section]
    with pytest.raises(StudyError, match=rf"^{section}: missing"):
        parse(study)


def test_all_mistakes_are_reported_at_once():
    study = changed(changed(tiny_study(), "spec.kernel_size", 50), "images.sise", 3)
    with pytest.raises(StudyError) as error:
        parse(study)
    assert "spec.kernel_size = 50" in str(error.value) and "images.sise = 3" in str(error.value)


# key of format 1, a value that it had, what the message must name instead
RENAMED = [
    ("spec.kernel", 11, "kernel_size"),
    ("specs", {"singlet": {"kernel": 11}}, "kernel_size"),
    ("capture.outside", "veil", "outside_window"),
    ("outside", {"phone": {"elements": "quadruplet", "file": str(PLASTICS)}}, "imported"),
    ("minutes", {"images": 0.1}, "gone"),
    ("fine_tuning.rate", 1e-3, "learning_rate"),
    ("fine_tuning.batch", 20, "batch_size"),
    ("restoration.rate", 1e-3, "learning_rate"),
    ("restoration.batch", 4, "batch_size"),
    ("classifiers.small.training.rate", 1e-3, "learning_rate"),
    ("designs.tasklens.images", 2, "batch_size"),
    ("designs.tasklens.starts", 2, "restarts"),
    ("designs.tasklens.start", {"steps": 2, "pixels": [20, 5]}, "restart"),
    ("designs.tasklens.refine", {"steps": 2, "pixels": [5, 1]}, "refinement"),
    ("designs.tasklens.restart.stride", 0.5, "step_size"),
    ("designs.tasklens.size", 16, "a key of each descent"),
    ("designs.tasklens.polish.network_rate", 1e-5, "network_learning_rate"),
    ("designs.imaging1.rates", "ours", "learning_rates"),
    ("designs.end_to_end_from_flat.images", 2, "batch_size"),
    ("designs.end_to_end_from_flat.rates", "paper", "learning_rates"),
    ("ablations.mine", {"elements": "singlet", "design": "imaging1", "variants": {"a": {"rates": "paper"}}},
     "learning_rates"),
]  # fmt: skip


LATE = ("specs", "ablations.mine")  # looked into when all else is right


@pytest.mark.parametrize("key, value, now", RENAMED, ids=[key for key, *_ in RENAMED])
def test_a_key_of_format_1_names_the_one_of_today(key, value, now):
    """In one line, with the old key, beside whatever else is wrong."""
    study = changed(tiny_study(), key, value)
    with pytest.raises(StudyError) as error:
        parse(study if key in LATE else changed(study, "images.sise", 3))
    (line,) = (line for line in str(error.value).splitlines() if "since format 2" in line)
    old = {"specs": "kernel", "ablations.mine": "rates"}.get(key, key.rpartition(".")[2])
    assert all(part in line for part in key.split("."))
    assert now in line.partition(f"since format 2 `{old}` is ")[2]
    assert ("images.sise = 3" in str(error.value)) == (key not in LATE)


def test_a_study_of_format_1_hears_of_all_its_keys_at_once():
    """At any depth, with the format; a key that is renamed and wrong besides has a line for each."""
    study, keys = changed(tiny_study(), "format", 1), 0
    for key, value, _ in RENAMED:
        if key not in (*LATE, "designs.tasklens.restart.stride"):  # which the old `start` replaces
            study, keys = changed(study, key, value), keys + 1
    with pytest.raises(StudyError) as error:
        parse(changed(study, "spec.kernel", 50))
    message = str(error.value)
    assert "format = 1: expected 2" in message
    assert "spec.kernel = 50: since format 2" in message and "spec.kernel_size = 50: expected an odd" in message
    assert message.count("since format 2") == keys
    assert len(message.splitlines()) == 1 + keys + 2 and "unknown key" not in message


def test_best_imaging_needs_an_imaging_design():
    study = tiny_study()
    study["designs"] = {"e2e": study["designs"]["end_to_end_from_imaging"]}
    with pytest.raises(StudyError, match=r"designs\.e2e\.start"):
        parse(study)


IMPOSSIBLE = [
    ("spec.wavelengths_um", [2.4, 0.6, 0.5]),  # outside the plastic's fitted range
    ("images", {"size": 16, "train": 1, "minival": 1, "test": 3}),  # fewer images than classes
    ("spec.wavelengths_um", [0.4861, 0.5893, 0.6563]),  # blue, green, red
    ("constraints.min_back_focus", 3.8),  # no room left for plates
    ("constraints.max_track", 0.5),
    ("constraints.flat_track", 0.2),
    ("constraints.min_centre_thickness", 2.0),  # above the largest
    ("seeds", [0, 0]),
    ("tables", ["table1", "table1"]),
    ("fine_tuning.learning_rate", math.inf),
]


@pytest.mark.parametrize("key, value", IMPOSSIBLE)
def test_an_impossible_value_fails_before_the_first_job(key, value):
    with pytest.raises(StudyError):
        parse(changed(tiny_study(), key, value))


def test_yaml_reads_1e_4_as_text_and_the_study_as_a_number(tmp_path):
    """YAML 1.1 wants 1.0e-4; what people write is taken as meant."""
    text = yaml.safe_dump(changed(tiny_study(), "fine_tuning.learning_rate", 1)).replace(
        "learning_rate: 1\n", "learning_rate: 1e-4\n"
    )
    assert isinstance(yaml.safe_load(text)["fine_tuning"]["learning_rate"], str)
    (tmp_path / "study.yaml").write_text(text)
    assert load(tmp_path / "study.yaml").fine_tuning.learning_rate == 1e-4


def test_rates_have_presets():
    """The paper's (section 3.3) and ours, under their names; a study file may also spell them out."""

    def rates(given) -> LearningRates:
        return parse(changed(tiny_study(), "designs.imaging1.learning_rates", given)).designs["imaging1"].learning_rates

    named = rates("paper")
    assert (named.curvature, named.thickness, named.alpha_4, named.decay) == (1e-4, 1e-4, 1e-4, 0.02)
    assert not named.normalised and named.final == 1
    assert rates(named.model_dump()) == named != rates("ours")


@pytest.mark.parametrize("text", ["", "[]", "- 1", "just words", "a: [1", "3"])
def test_a_file_that_is_no_mapping_is_a_mistake_like_any_other(tmp_path, text):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(StudyError):
        load(tmp_path / "study.yaml")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.name)
def test_the_studies_we_ship_can_be_read(path):
    study = load(path)
    assert study.lenses and study.supervisor in study.classifiers


def test_the_resolved_study_is_the_same_study(tmp_path):
    """What is written for the jobs has every default in it and reads back as an equal."""
    study = parse(tiny_study())
    (tmp_path / "study.yaml").write_text(dump(study))
    assert load(tmp_path / "study.yaml") == study
    assert "evaluation_rays" in dump(study) and "max_slope" in dump(study)


def test_a_study_cannot_be_changed():
    study = parse(tiny_study())
    with pytest.raises(Exception, match="frozen"):
        study.images.size = 32


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
    for call, name in ((study.lens, "doublet"), (study.classifier, "nobody")):
        with pytest.raises(StudyError, match=name):
            call(name)


def test_an_imported_lens_is_a_lens_of_the_study(tmp_path):
    """The last one, of elements that need not exist; a resolved study keeps it."""
    study = parse(with_imported(catalogues=[str(PLASTICS)]))
    assert list(study.lenses) == [*parse(tiny_study()).lenses, "quadruplet-phone"]
    assert study.lens("quadruplet-phone").elements == "quadruplet" and "quadruplet" not in study.elements
    (tmp_path / "study.yaml").write_text(dump(study))
    assert load(tmp_path / "study.yaml") == study


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


@pytest.mark.parametrize(
    "text, words",
    [
        ("name: a\nname: b\n", "line 2, column 1: name stands twice; remove one"),
        ("spec:\n  f_number: 2\n  f_number: 4\n", "line 3, column 3: f_number stands twice"),
        ("designs: {a: {steps: 1, steps: 2}}\n", "line 1, column 25: steps stands twice"),
        ("seeds: [05]\n", "line 1, column 9: YAML reads 05 as 5"),
        ("seeds: [017]\n", "YAML reads 017 as 15; write 15, or another number"),
        ("images: {test: 1:30}\n", "line 1, column 16: YAML reads 1:30 as 90"),
    ],
)
def test_yaml_that_is_not_what_it_seems_is_refused(tmp_path, text, words):
    write(tmp_path / "study.yaml", text)
    with pytest.raises(StudyError) as caught:
        read(tmp_path / "study.yaml")
    assert str(caught.value).startswith(f"{tmp_path}/study.yaml, ") and words in str(caught.value)


def test_yaml_with_anchors_and_merged_keys_is_read(tmp_path):
    """A key may change what `<<` brings; 0, 10 and quoted numbers are what they seem."""
    text = "a: &a {steps: 10, seed: 0}\nb: {<<: *a, steps: 2}\nc: ['05', *a, *a]\n"
    write(tmp_path / "study.yaml", text)
    assert read(tmp_path / "study.yaml")["b"] == {"steps": 2, "seed": 0}


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("seeds", [True], "seeds.0 = true: expected a whole number"),
        ("images.seed", True, "images.seed = true: expected a whole number"),
        ("images.test", True, "images.test = true: expected a whole number"),
        ("seeds", [2**70], "seeds.0 = 1180591620717411303424: expected less than 92233720368547"),
    ],
)
def test_truth_is_no_number(key, value, words):
    with pytest.raises(StudyError) as caught:
        parse(changed(tiny_study(), key, value))
    assert words in str(caught.value)
