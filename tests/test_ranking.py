"""Lenses are ranked for a network by a command, which screens them for a sensor and writes a page."""

import subprocess
import sys
from pathlib import Path

import numpy
import pandas
import pytest
import timm
import torch
import yaml
from examples import random_images, trained_resnet, write_photographs
from studies import measurement
from typed_lenses import singlet

import tasklens
from tasklens.cli.app import main
from tasklens.optics.analysis.object_points import image_scale
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.io import imported
from tasklens.optics.view import view_of_spec
from tasklens.runtime.files import FileError, read_tensors, write_tensors
from tasklens.settings.lens_entries import ImportedLens
from tasklens.settings.specification import Spec
from tasklens.study.run import ranking_run as pipeline
from tasklens.study.run import screening


@pytest.mark.parametrize("scaled", [True, False])
def test_the_image_of_a_near_object_ends_at_the_corner_of_the_sensor(tmp_path, scaled):
    """It is larger than that of an object at infinity: the outermost chief ray lands where the sensor ends."""
    lens, view = singlet(field_of_view_deg=40)
    tasklens.save_lens(tmp_path / "lens.yaml", lens, view)
    half = 0.8 * float(view.radii.max())
    sensor = {"diagonal_mm": 2 * half, "object_distance_mm": 25.0}
    screened = screening.screen([tmp_path / "lens.yaml"], sensor, [], scaled)
    (entry,) = screened.entries.values()
    spec = Spec.model_validate(sensor | entry["spec"])
    near = view_of_spec(spec)
    fitted, _ = imported.fit(ImportedLens.model_validate(entry), near, spec.f_number)
    assert float(near.radii.max() * image_scale(fitted, near)) == pytest.approx(half, rel=1e-6)
    assert float(near.radii.max()) < 0.97 * half
    efl = float(paraxial(fitted, near.reference_um).efl)
    assert (efl == pytest.approx(view.efl, rel=1e-6)) != scaled


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five lenses, two of which cannot be used; sixty photographs of three classes; a network that knows them."""
    folder = tmp_path_factory.mktemp("rank")
    images = random_images(60, 32, 3, seed=0)
    write_photographs(folder / "photographs", images, ("cat", "dog", "owl"))
    trained_resnet(folder / "mine.safetensors", images, epochs=5, batch_size=10)
    (folder / "lenses").mkdir()
    for name, lens in {
        "sharp": singlet(),
        "Fast.2": singlet(f_number=2.8),
        "narrow": singlet(field_of_view_deg=10),
    }.items():
        tasklens.save_lens(folder / "lenses" / f"{name}.yaml", *lens)
    tasklens.save_lens(folder / "lenses" / "sharp_too.zmx", *singlet())
    (folder / "lenses" / "notes.yaml").write_text("no: lens\n")
    (folder / "lenses" / ".hidden.yaml").write_text("no: lens\n")
    return folder


@pytest.fixture
def here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


COMMAND = ("rank", "lenses", "--images", "photographs", "--network", "test_resnet")
WEIGHTS = ("--weights", "mine.safetensors")
SMALL = ("--size", "32", "--kernel-size", "15", "--diagonal", "1.0", "--pixel-pitch", "4", "--max-images", "40")
SENSOR = (*WEIGHTS, *SMALL)


@pytest.fixture(scope="module")
def ranked(folder):
    """The command for all lenses, as a program."""
    command = [sys.executable, "-m", "tasklens.cli", *COMMAND, *SENSOR]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_the_command_ranks_a_folder_of_lenses(here, ranked, capfd):
    """A table, a page, and reasons for what is not measured; two lenses that are the same are equal."""
    assert ranked.returncode == 0, ranked.stderr
    assert "the network recognises" in ranked.stderr
    assert "3 of 5 lenses are measured with 40 of 60 photographs" in ranked.stderr
    table = pandas.read_csv("results/ranking/tables/ranking.csv").set_index("lens")
    assert set(table.index) == {"sharp", "sharp_too", "Fast.2"} and (table["accuracy"] > 40).all()
    assert table.loc["sharp", "accuracy"] == pytest.approx(table.loc["sharp_too", "accuracy"], abs=1e-9)
    assert table["group"].min() == 1
    assert "narrow: covers 0." in ranked.stdout and "mm of the sensor's diagonal of 1 mm" in ranked.stdout
    assert "notes: not a lens" in ranked.stdout and "hidden" not in ranked.stdout
    page = (here / "results/ranking/ranking.html").read_text()
    assert page.count("<article") == 3 and "Not measured" in page and "covers 0." in page
    assert "://" not in page and "data:image/svg+xml" in page

    assert main([*COMMAND, *SENSOR]) == 0
    assert "Nothing to be done" in capfd.readouterr().err


@pytest.mark.slow
def test_built_lenses_and_a_sieve(here, capfd, monkeypatch):
    """The two lenses of the highest MTF are measured, and the first one is built in simulation."""
    study_of, few = pipeline.study, {"tolerances": {"lenses": 10, "images": 10}}
    monkeypatch.setattr(pipeline, "study", lambda *arguments: study_of(*arguments) | few)
    options = ("--sieve", "3", "--as-built", "1", "--name", "built")
    sensor = ("--full-well", "500", "--scale", "--object-distance", "100")
    assert main([*COMMAND, *SENSOR, *options, *sensor]) == 0
    output = capfd.readouterr().out
    table = pandas.read_csv("results/built/tables/ranking.csv")
    assert len(table) == 3 and table["built_lose"].notna().tolist() == [True, False, False]
    assert "Not measured: 1 lens with a mean MTF of at most" in output
    study = yaml.safe_load((here / "results/built/study.yaml").read_text())
    (first, *_) = sorted((here / "results/built/lenses").glob("*/seed0/lens.yaml"))
    content = yaml.safe_load(first.read_text())
    assert content["object_distance_mm"] == content["spec"]["object_distance_mm"] == 100
    assert content["figures"]["object_distance_mm"] == pytest.approx(100)
    left = set(study["ranking"]["mtf"]) - {f"lens-{name}" for name in study["imported"]}
    assert len(left) == 1 and study["capture"]["sensor"]["full_well"] == 500
    assert all(study["ranking"]["mtf"][name] <= min(table["mtf_mean"]) for name in left)


@pytest.mark.slow
def test_a_network_that_gets_used_to_each_lens(here):
    """After an epoch of fine-tuning, through PSFs with diffraction; all other photographs are for the training."""
    more = ("--fine-tune", "1", "--diffraction", "--name", "tuned", "--max-images", "20")
    assert main(["rank", "lenses/sharp.yaml", *COMMAND[2:], *SENSOR, *more]) == 0
    assert "after 1 epochs of fine-tuning" in (here / "results/tuned/ranking.html").read_text()
    study = yaml.safe_load((here / "results/tuned/study.yaml").read_text())
    assert study["images"]["train"] is None and study["capture"]["diffraction"]
    (psfs,) = (here / "results/tuned/lenses").rglob("psf.safetensors")
    assert read_tensors(psfs)[1]["diffraction"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (COMMAND[:2], "expected --images FOLDER and --network NAME"),
        (COMMAND, "give one of --weights FILE, --pretrained"),
        ((*COMMAND[:1], "nowhere", *COMMAND[2:], *SENSOR), "nowhere: no such lens file or folder"),
        ((*COMMAND[:1], "photographs", *COMMAND[2:], *SENSOR), "photographs: no lens file there"),
        (
            (*COMMAND[:1], "lenses/narrow.yaml", *COMMAND[2:], *SENSOR),
            "none of the lenses can be measured: narrow: covers",
        ),
        ((*COMMAND, *SENSOR, "--as-built", "1", "--diffraction"), "--as-built: not with --diffraction"),
        ((*COMMAND, *SENSOR, "--grade", "phone_moulding"), "--grade: only with --as-built COUNT"),
        ((*COMMAND, *SENSOR, "--wavelengths", "0.5,0.6,0.7"), "wavelengths_um"),
        ((*COMMAND, *SENSOR, "--name", "My-Lenses"), "name = 'My-Lenses'"),
        ((*COMMAND, *SENSOR, "--diagonal", "-1"), "diagonal_mm = -1.0: expected greater than 0"),
        ((*COMMAND, *SENSOR, "--images", "lenses"), "images.folder = lenses: expected a folder test or val in it"),
    ],
)
def test_mistakes_are_one_line(here, capsys, arguments, words):
    assert main(list(arguments)) == 2
    assert words in capsys.readouterr().err.splitlines()[-1]


def test_a_network_that_recognises_nothing_ranks_nothing(here, capsys):
    weights = timm.create_model("test_resnet", num_classes=3).state_dict()
    write_tensors(here / "zero.safetensors", {name: torch.zeros_like(value) for name, value in weights.items()}, {})
    assert main([*COMMAND, *SENSOR, "--weights", "zero.safetensors"]) == 2
    assert "no better than guessing" in capsys.readouterr().err.splitlines()[-1]


def test_names_of_lenses_in_a_study(tmp_path):
    """Unique names of small letters, digits and underscores; files of equal names have their folder in the title."""
    paths = [tmp_path / "a" / "Lens 1.zmx", tmp_path / "b" / "Lens 1.zmx", tmp_path / "c.zmx"]
    assert screening._name(paths[0], []) == "lens_1" and screening._name(paths[1], ["lens_1"]) == "lens_1_2"
    assert screening._title(paths[2], paths) == "c" and screening._title(paths[0], paths).endswith("a/Lens 1.zmx")


def test_lenses_are_screened_for_a_sensor(here, capsys):
    """Lenses keep size and F-number; with `scaled`, a narrow lens is enlarged until its field fills the sensor."""
    paths = screening.lens_paths([here / "lenses"])
    assert [path.name for path in paths] == ["Fast.2.yaml", "narrow.yaml", "notes.yaml", "sharp.yaml", "sharp_too.zmx"]
    sensor = {"diagonal_mm": 1.0, "pixel_pitch_um": 4.0, "kernel_size": 15}
    screened = screening.screen(paths, sensor, [], scaled=False)
    assert set(screened.entries) == {"fast_2", "sharp", "sharp_too"} and set(screened.left_out) == {"narrow", "notes"}
    assert screened.titles["fast_2"] == "Fast.2" and screened.mtf["sharp"] == pytest.approx(screened.mtf["sharp_too"])
    assert screened.entries["fast_2"]["spec"]["f_number"] == pytest.approx(2.8, rel=1e-3)
    focal_length = tasklens.load_lens(here / "lenses/sharp.yaml")[1].efl
    half = numpy.radians(screened.entries["sharp"]["spec"]["field_of_view_deg"] / 2)
    assert 0.5 / numpy.tan(half) == pytest.approx(focal_length, rel=1e-3)
    assert "ranked at" not in capsys.readouterr().err
    screening.screen(paths, sensor | {"wavelengths_um": (0.9, 0.85, 0.8)}, [], scaled=False)
    assert "is designed for 0.6563, 0.5893, 0.4861 um, and ranked at 0.9, 0.85, 0.8 um" in capsys.readouterr().err
    scaled = screening.screen(paths, sensor, [], scaled=True)
    assert scaled.entries["narrow"]["spec"]["field_of_view_deg"] == pytest.approx(10, rel=1e-6)


def test_a_fifth_of_a_folder_is_tested_if_the_network_is_trained(tmp_path):
    """So that photographs remain to train with; without training, all but three are tested."""
    for k in range(60):
        (tmp_path / f"class{k % 2}").mkdir(exist_ok=True)
        (tmp_path / f"class{k % 2}" / f"{k}.png").touch()
    for most, trained, focused, test, others in (
        (500, True, False, 12, "; the network is trained on others"),
        (5, True, False, 5, "; the network is trained on others"),
        (500, False, False, 57, "; 3 others are needed as training images"),
        (500, False, True, 34, "; 26 others are for the focus"),
    ):
        images = pipeline.image_settings(tmp_path, 32, most, trained, focused)
        assert images["test"] == test and pipeline.photographs(images) == f"{test} of 60 photographs{others}"
    for split, count in (("train", 16), ("test", 4)):
        for k in range(count):
            (tmp_path / "split" / split / f"class{k % 2}").mkdir(parents=True, exist_ok=True)
            (tmp_path / "split" / split / f"class{k % 2}" / f"{k}.png").touch()
    images = pipeline.image_settings(tmp_path / "split", 32, 500, False, True)
    assert pipeline.photographs(images) == "4 photographs; 14 of the training photographs set the focus"
    for k in range(6):
        (tmp_path / "split/train/class0" / f"{2 * k}.png").unlink()
    with pytest.raises(FileError, match="has 8 photographs by which the network can set the focus; expected 10 or"):
        pipeline.image_settings(tmp_path / "split", 32, 500, False, True)
    with pytest.raises(FileError, match="too few photographs for a ranking"):
        (tmp_path / "few" / "a").mkdir(parents=True)
        pipeline.image_settings(tmp_path / "few", 32, 500, True, False)


def test_a_field_beyond_the_sensor_is_named(capsys):
    """A lens of a larger sensor is measured on the part of its field that the sensor sees."""
    path = Path(__file__).parents[1] / "config" / "lenses" / "phone_3p.yaml"
    entry = screening.screen([path], {}, [], scaled=False).entries["phone_3p"]
    assert "has a field of 4.77 mm, used up to the sensor's diagonal of 4 mm" in capsys.readouterr().err
    assert entry["spec"]["field_of_view_deg"] == pytest.approx(71.85, abs=0.01)


FUNCTION = """
import timm
from safetensors.torch import load_file
def build(num_classes):
    network = timm.create_model("test_resnet", num_classes=num_classes)
    network.load_state_dict(load_file("mine.safetensors"))
    return network
"""


@pytest.mark.slow
def test_a_function_of_ones_own_is_ranked_alike(here, ranked, monkeypatch):
    """The workflow's jobs can use it: it loads its own weights, and has the answers of the named network."""
    monkeypatch.setattr(sys, "path", sys.path[:])
    (here / "own_nets.py").write_text(FUNCTION)
    options = ("--network", "own_nets:build", "--name", "own")
    assert main(["rank", "lenses/sharp.yaml", *COMMAND[2:4], *SMALL, *options]) == 0
    own, by_name = (measurement(name, "lens-sharp", "network", kind="-predictions") for name in ("own", "ranking"))
    assert own.read_text() == by_name.read_text()


def test_a_wrong_name_is_refused_before_lenses_are_read(here, capsys, monkeypatch):
    def unexpected(*_):
        raise AssertionError("lenses are read")

    monkeypatch.setattr(screening, "screen", unexpected)
    assert main([*COMMAND, *SENSOR, "--name", "My-Lenses"]) == 2
    assert "name = 'My-Lenses'" in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(AssertionError, match="lenses are read"):
        main([*COMMAND, *SENSOR])
