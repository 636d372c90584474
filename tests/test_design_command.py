"""`tasklens design`: one lens without a study, its file, and refused options."""

import json
import shutil

import numpy
import pytest
import timm
import torch
import yaml
from examples import random_images, trained_resnet, write_photographs
from safetensors.torch import load_file, save_file

from tasklens.cli.app import main
from tasklens.materials.catalogues import builtin
from tasklens.optics.io import lens_files
from tasklens.recognition.dataset import unused_images
from tasklens.runtime.files import FileError
from tasklens.settings.lens_settings import lens_settings, with_starts

QUICK = ("--elements", "COC", "--set", "evaluations=100", "--set", "starts=3")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Forty images of each of three classes that differ in brightness, and weights of a network trained on them."""
    folder, images = tmp_path_factory.mktemp("trained"), random_images(120, 40, 3, seed=0)
    write_photographs(folder / "photographs", images, ("cat", "dog", "owl"))
    trained_resnet(folder / "mine.safetensors", images, epochs=4, batch_size=8)
    return folder


@pytest.fixture
def photographs(here, trained):
    """The current folder, with these photographs and weights."""
    (here / "photographs").symlink_to(trained / "photographs")
    shutil.copy(trained / "mine.safetensors", here)
    return here


def design(*arguments) -> int:
    return main(["design", *map(str, arguments)])


def test_a_lens_by_least_squares(here, capsys):
    """With the given F-number and field, and within its limits, one of them given."""
    options = (*QUICK, "--f-number", "4", "--field-of-view", "40", "--limit", "max_track=8")
    assert design(*options, "-o", "lens.yaml", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["file"] == "lens.yaml" and summary["materials"] == ["COC"]
    assert summary["f_number"] == pytest.approx(4, rel=0.03)
    assert 4.4 < summary["track_mm"] <= 8
    assert summary["fields"]["angle_deg"][-1] == pytest.approx(20, abs=1e-9)
    assert max(summary["fields"]["rms_centroid_um"]) < 20 and summary["worst_margin"]["value"] > 0
    content = yaml.safe_load((here / "lens.yaml").read_text())
    assert content["origin"]["method"] == "least_squares" and content["figures"]["efl_mm"] == summary["efl_mm"]
    assert main(["lens", "show", "lens.yaml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lens.yaml"]["fields"] == summary["fields"]

    assert design(*options, "-o", "lens.zmx") == 0
    native, exported = (lens_files.read(here / f"lens.{suffix}") for suffix in ("yaml", "zmx"))
    assert torch.equal(native.lens.curvature, exported.lens.curvature)
    assert torch.equal(native.lens.thickness, exported.lens.thickness)
    assert exported.view.radii.max() / exported.view.efl == pytest.approx(numpy.tan(numpy.radians(20)), rel=1e-6)


def test_a_lens_of_a_plastic_in_the_folder_of_catalogues(here, monkeypatch):
    """Without naming its file."""
    (here / "mine").mkdir()
    (here / "mine/maker.yaml").write_text(yaml.safe_dump({"MINE": builtin("PMMA").definition()}))
    monkeypatch.setenv("TASKLENS_CATALOGUES", "mine")
    assert design("--elements", "MINE", "--set", "evaluations=10", "--set", "starts=1", "-o", "lens.yaml") == 0
    assert [medium.name for medium in lens_files.read(here / "lens.yaml").lens.media][1] == "MINE"


@pytest.mark.slow
def test_a_lens_for_ones_own_network(photographs, capsys):
    """By its loss on the user's images, from flat plates; with or without a verdict it is the same lens.

    Then both together, from this lens and this network.
    """
    network = ("--network", "test_resnet", "--weights", "mine.safetensors", "--images", "photographs", *SMALL)
    descents = "descents=[{steps: 2, pixels: [20, 5]}, {steps: 2, pixels: [5, 1]}]"
    few, flat = ("--set", "rays=16", "--set", "batch_size=2"), ("--set", "start=flat", "--set", descents)
    arguments = ("--method", "task", "--elements", "COC", *network, *few, *flat)
    assert design(*arguments, "-o", "mine.yaml") == 0
    output = capsys.readouterr()
    assert "recognises" in output.err and "96 sharp images (guessing: 33.3%)" in output.err
    assert "descent 2  step 2/2  loss" in output.err and "design: task by descents, seed 0" in output.out
    assert design(*arguments, "-o", "alone.yaml", "--no-verdict") == 0
    joint = ("--start", "mine.yaml", "--method", "joint", *network, *few, "--set", "descents.0.steps=10")
    assert design(*joint, "-o", "joint.yaml", "--save-network", "joint.safetensors") == 0
    content = yaml.safe_load((photographs / "joint.yaml").read_text())
    assert content["origin"]["start"] == "mine.yaml"
    mine, alone, better = (lens_files.read(photographs / f"{name}.yaml").lens for name in ("mine", "alone", "joint"))
    assert torch.equal(mine.curvature, alone.curvature) and mine.curvature.any()
    assert better.media == mine.media and not torch.equal(better.curvature, mine.curvature)
    before, trained = (load_file(photographs / f"{name}.safetensors") for name in ("mine", "joint"))
    assert before.keys() == trained.keys() and any(not torch.equal(before[name], trained[name]) for name in before)


def test_a_verdict_is_on_the_classes_of_the_design(tmp_path):
    """Labels are numbers of classes; without a folder they would be those of other classes."""
    write_photographs(tmp_path / "train", random_images(30, 16, 3, seed=0), ("a", "b", "c"))
    write_photographs(tmp_path / "test", random_images(30, 16, 2, seed=1), ("b", "c"))
    with pytest.raises(FileError, match="train and test have different classes: a"):
        unused_images(tmp_path, 16)
    write_photographs(tmp_path / "test", random_images(30, 16, 3, seed=2), ("a", "b", "c"))
    assert unused_images(tmp_path, 16).classes == ("a", "b", "c")


def test_a_network_that_recognises_nothing_designs_nothing(photographs, capsys):
    """This network always gives the same answer; no file is written."""
    weights = timm.create_model("test_resnet", num_classes=3).state_dict()
    save_file({name: torch.zeros_like(value) for name, value in weights.items()}, photographs / "zero.safetensors")
    assert design(*TASK, "--weights", "zero.safetensors", "--images", "photographs", *SMALL, "-o", "mine.yaml") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert "no better than guessing; check its weights, its normalisation" in message
    assert not (photographs / "mine.yaml").exists()


SMALL, TASK = ("--size", "32", "--kernel-size", "11"), ("--method", "task", "--network", "test_resnet")
MINE = (*TASK, "--weights", "words.pth")
VIT = (*MINE, "--images", "photographs", *SMALL, "--network", "vit_tiny_patch16_224", "--argument", "img_size=32")
MISTAKES = [
    (("--elements", "COC,GLASS"), "elements: unknown glass 'GLASS' in the built-in plastics"),
    (("--method", "magic"), "method 'magic': expected one of least_squares, spot, contrast, log_image_error, "),
    (("--method", "task", "--save-network", "a.safetensors"), "--save-network: only with --method joint or end_to_end"),
    (("--method", "task"), "method task: needs a network: --network NAME --weights FILE, in Python `network`"),
    ((*MINE, "--method", "joint"), "--method joint: trains the network with the lens; give"),
    (TASK, "--network test_resnet: give one of --weights FILE, --pretrained"),
    ((*TASK, "--weights", "absent.pth"), "--weights absent.pth: no such file"),
    ((*MINE, "--images", "absent"), "absent: no such folder of images"),
    ((*MINE, "--images", "photographs", "--set", "start=[correlation]"), "start: correlation is a lens of the verdict"),
    ((*MINE, "--images", "photographs", *SMALL), "words.pth: no weights for test_resnet with 3 outputs"),
    ((*VIT, "--set", "descents.0.size=24"), "Input height (24) doesn't match model (32)"),
    ((*MINE, "--network", "resnt"), "--network resnt: Unknown model (resnt); did you mean resnet"),
    (
        (*MINE, "--method", "joint", "--save-network", "a.safetensors", "--set", "start=[contrast,spot]"),
        "joint starts from one lens, got lens-contrast, lens-spot; choose one with `start` (on the command line --set",
    ),
    (("--set", "evaluationz=3"), "designs.least_squares.evaluationz = 3: unknown key; did you mean evaluations?"),
    (("--set", "a=1", "--set", "a.b.c=2"), "--set a.b.c=2: a has the value 1 from another --set"),
    (("--set", "a.b=2", "--set", "a=1"), "--set a=1: a has the values {'b': 2} from another --set"),
    (("--set", "evaluations"), "--set evaluations: expected KEY=VALUE, such as descents.0.steps=200"),
    (("--limit", "max_trak=6"), "--limit max_trak = 6: unknown key; did you mean max_track?"),
    (("--field-of-view", "40"), "focuses within --limit max_track = 4.4 mm"),
    (("--f-number", "-1"), "--f-number = -1.0: expected greater than or equal to 0.5"),
    (("--wavelengths", "2.4,0.6,0.5"), "2.4 um of lens is outside the 0.334 to 2.325 um"),
    (("--catalogue", "absent.yaml"), "absent.yaml: cannot be read: No such file or directory"),
    (("--network", "test_resnet", "--weights", "words.pth"), "method least_squares: has no network; choose task"),
    (("--method", "contrast", "--images", "photographs", "--size", "32"), "method contrast: has no images"),
    (("--method", "contrast", "--size", "128"), "size: only for a folder of photographs"),
    ((*MINE, "--set", "descents.0.network_learning_rate=1e-4"), "only with the methods joint and end_to_end, not task"),
    (("--elements", "COC|PMMA"), "unknown glass 'COC|PMMA'"),
    (("--weights", "words.pth"), "--weights, --pretrained, --outputs, --argument: only with --network NAME"),
    ((*MINE, "--set", "descents=5"), "designs.task.descents = 5: expected a list"),
    (("-o", "lens.txt"), "lens.txt: expected a name that ends in .yaml or .yml or .zmx"),
    (("-o", "words.yaml"), "words.yaml: already exists; --force overwrites it"),
]


@pytest.mark.parametrize("arguments, words", MISTAKES, ids=[" ".join(a[-2:]) for a, _ in MISTAKES])
def test_a_mistake_is_one_line_before_the_first_step(photographs, capsys, arguments, words):
    for name in ("words.pth", "words.yaml"):
        (photographs / name).write_text("mine")
    assert design("-o", "new.yaml", *arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("reading photographs")]
    assert line.startswith("tasklens: ") and words in line and len(line) < 500
    assert not (photographs / "new.yaml").exists() and (photographs / "words.yaml").read_text() == "mine"


def test_baselines_do_not_have_the_keys_of_a_network():
    """They have no network whose batch norms could use the statistics of a batch."""
    keys, network = with_starts("task", {"batch_norm": "batch"}, None), {"model": "resnet18", "pretrained": True}
    designs = lens_settings("task", keys, 51, None, network, ("correlation",)).designs
    assert designs["task"].batch_norm == "batch" and designs["correlation"].batch_norm == "stored"
    assert [descent.criterion for descent in designs["correlation"].descents] == ["correlation"]
