"""`tasklens study new` as a user types it: its study files, their limits of time and its error messages."""

from pathlib import Path

import pytest
import timm
import torch
import yaml
from examples import write
from PIL import Image
from safetensors.torch import save_file
from studies import tiny_study
from study_command import complaint, study
from typer.testing import CliRunner

from tasklens.cli.app import app
from tasklens.study.loading import load
from tasklens.study.run import forecast, new_study, planning
from tasklens.study.run.digest import SNAKEFILE

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture
def unplanned(monkeypatch):
    """Every design takes a minute in each table, in place of a dry run of Snakemake."""

    def plan(files, target) -> dict:
        config = load(*files)
        labels = [f"{design} {table}" for design in config.designs for table in config.tables]
        return {config.name: {"design": planning.Planned(missing=labels)}}

    monkeypatch.setattr(planning, "plan", plan)
    monkeypatch.setattr(forecast.Durations, "total", lambda _, rules: (60 * len(rules), []))


def photographs(train: int, test: int, classes: str = "ab") -> None:
    """Empty files of photographs of each class in the folder `photos`."""
    for split, count in (("train", train), ("test", test)):
        for path in (f"photos/{split}/{name}/{k}.jpg" for name in classes for k in range(count)):
            write(path, "")


def request(networks: str, folder: Path | None = None, weights: Path | None = None) -> new_study.StudyRequest:
    elements = {"doublet": ["COC", "OKP4"]}
    return new_study.StudyRequest("mine", folder, 64, tuple(networks.split()), elements, 2.8, 68.8, 1, weights)


def test_a_new_study_follows_its_options(here, capsys):
    """Options alone make a study file that loads; the command prints the next step."""
    options = "--networks vit,resnet --elements mine=COC+OKP4 --f-number 2.2 --field-of-view 50"
    assert study("new", "wide", *options.split(), "--minutes", "600", "--yes") == 0
    config = load("wide.yaml")
    assert (config.name, config.supervisor, list(config.classifiers)) == ("wide", "vit", ["vit", "resnet"])
    assert config.elements == {"mine": ("COC", "OKP4")}
    assert (config.spec.f_number, config.spec.field_of_view_deg, config.seeds) == (2.2, 50.0, (0,))
    out = capsys.readouterr().out
    assert out.startswith("wide.yaml: all four tables, about ")
    assert f"snakemake -j2 tables -s {SNAKEFILE} --configfile wide.yaml" in out  # it is not in this folder
    text = (here / "wide.yaml").read_text()
    assert out.splitlines()[0].partition("about ")[2] in text and text.count("\n# ") > 8


def test_a_new_study_asks_for_what_was_not_given(unplanned):
    """An empty answer takes the default; the command does not ask about values given as options."""
    answers = ["", "", "triplet", "3.5", "", "1", "45"]
    result = CliRunner().invoke(app, ["study", "new", "asked"], input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.output
    config = load("asked.yaml")
    assert (list(config.elements), config.spec.f_number, config.seeds) == (["triplet"], 3.5, (0,))
    assert config.images.folder is None and list(config.classifiers) == ["resnet"]
    result = CliRunner().invoke(app, ["study", "new", "b", "--seeds", "2", "--f-number", "4"], input=6 * "\n")
    assert result.exit_code == 0 and "Seeds" not in result.output and "F-number" not in result.output
    assert load("b.yaml").seeds == (0, 1)


def test_less_time_gives_a_smaller_study(unplanned):
    """Each shorter time gives fewer jobs or images."""
    sizes = []
    for minutes in ("600", "20", "5", "1"):
        assert study("new", "a", "--yes", "--force", "--cores", "1", "--minutes", minutes) == 0
        config = load("a.yaml")
        sizes.append((len(config.tables), len(config.designs), config.images.train))
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) >= 3


def test_a_new_study_of_photographs(unplanned):
    """The network starts from published weights, and the images have its size."""
    photographs(train=20, test=20)
    assert study("new", "mine", "--yes", "--images", "photos", "--networks", "resnet18", "--minutes", "9999") == 0
    config = load("mine.yaml")
    assert str(config.images.folder) == "photos" and config.images.size == 224
    assert config.images.minival == 8  # a fifth of 40
    assert config.classifiers["resnet18"].model == "resnet18" and config.classifiers["resnet18"].pretrained
    # It has the steps of the photographs study; each costs as much as twelve of the default study's.
    published = yaml.safe_load((ROOT / "config/photographs.yaml").read_text())
    assert config.designs["tasklens"].descents[-1].steps == published["designs"]["tasklens"]["descents"][-1]["steps"]
    write("mine.safetensors", "")
    options = ["--networks", "resnet18.a1_in1k", "--weights", "mine.safetensors", "--minutes", "9999", "--force"]
    assert study("new", "mine", "--yes", "--images", "photos", *options) == 0
    classifier = load("mine.yaml").classifiers["resnet18_a1_in1k"]
    assert (classifier.model, str(classifier.weights)) == ("resnet18.a1_in1k", "mine.safetensors")
    assert not classifier.pretrained
    assert classifier.training is None and classifier.outputs == "classes"  # it is used as it is
    options += ["--outputs", "imagenet", "--argument", "drop_rate=0.1"]
    assert study("new", "mine", "--yes", "--images", "photos", *options) == 0
    classifier = load("mine.yaml").classifiers["resnet18_a1_in1k"]
    assert classifier.outputs == "imagenet" and classifier.arguments == {"drop_rate": 0.1}


def test_a_check_of_networks_reads_their_weights(capsys):
    """The check loads the weights as the first job would, and so refuses weights of another network."""
    torch.manual_seed(0)
    save_file(timm.create_model("test_resnet", num_classes=10).state_dict(), "mine.safetensors")
    classifiers = {"small": {"model": "test_resnet", "weights": "mine.safetensors"}}
    write("mine.yaml", yaml.safe_dump(tiny_study() | {"classifiers": classifiers}))
    assert study("check", "mine.yaml", "--build-networks") == 0
    save_file(timm.create_model("test_resnet", num_classes=7).state_dict(), "mine.safetensors")
    assert study("check", "mine.yaml") == 0 and study("check", "mine.yaml", "--build-networks") == 2
    assert "no weights for test_resnet with 10 outputs" in capsys.readouterr().err


def test_a_new_study_of_a_folder_without_splits(here, unplanned):
    """A fifth of the photographs tests, a fifth of the others selects; check accepts the study."""
    for name in ("cat", "dog"):
        (here / "pets" / name).mkdir(parents=True)
        for k in range(25):
            Image.new("RGB", (8, 8), (5 * k, 0, 0)).save(here / "pets" / name / f"{k}.png")
    assert study("new", "pets", "--images", "pets", "--networks", "resnet", "--minutes", "600", "--yes") == 0
    images = load("pets.yaml").images
    assert (images.test, images.minival, images.train) == (10, 8, None)
    assert study("check", "pets.yaml", "--no-weight-files") == 0


def test_the_least_study_of_photographs_has_fewer_of_them():
    """A quarter of 400 - 80 training and 100 test images, as its forecast says."""
    photographs(train=200, test=50)
    sizes = [new_study.content(request("resnet", Path("photos")), cut)["images"] for cut in new_study.CUTS[-2:]]
    assert "train" not in sizes[0] and (sizes[1]["train"], sizes[1]["test"]) == (80, 25)


def test_more_photographs_than_were_ever_measured_have_no_forecast(monkeypatch, capsys):
    """The command says so, and takes all tables."""
    monkeypatch.setattr(planning, "plan", lambda *_: {"many": {"design": planning.Planned(missing=["a"])}})
    photographs(train=20, test=20)
    options = ("new", "many", "--yes", "--images", "photos", "--minutes", "30", "--force")
    assert study(*options) == 0 and "many.yaml: all four tables, about " in capsys.readouterr().out
    monkeypatch.setattr(forecast, "COMPARABLE", 10)
    assert (
        study(*options) == 0 and "many.yaml: all four tables, of unknown duration: no study" in capsys.readouterr().out
    )


def test_a_new_study_overwrites_nothing(here, capsys, unplanned):
    """The command overwrites a file only on request."""
    write("a.yaml", "mine")
    assert "--force" in complaint(capsys, "new", "a", "--yes")
    assert (here / "a.yaml").read_text() == "mine"
    assert study("new", "a", "--yes", "--output", "b.yaml") == 0 and load("b.yaml").name == "a"
    assert study("new", "a", "--yes", "--force") == 0 and load("a.yaml").name == "a"


def test_a_new_study_takes_a_network_of_three_classes(here, monkeypatch):
    """The head of a user's own network has the classes of the folder."""
    photographs(train=9, test=9, classes="abc")
    layers = "nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 3)"
    write("three_classes.py", f"from torch import nn\ndef net(num_classes): return nn.Sequential({layers})\n")
    monkeypatch.syspath_prepend(here)
    new_study.check(request("three_classes:net", Path("photos"), here / "any.safetensors"))


def test_a_new_study_that_does_not_fit_leaves_the_old_file(here, capsys, unplanned):
    write("a.yaml", "mine")
    assert "allow more time" in complaint(capsys, "new", "a", "--yes", "--force", "--minutes", "0.1")
    assert (here / "a.yaml").read_text() == "mine"


def test_without_the_repository_a_new_study_says_so(here, monkeypatch, capsys):
    """As from an installed wheel, in which all other commands work."""
    monkeypatch.setattr(new_study, "DEFAULT", here / "config.yaml")
    new_study.default_study.cache_clear()
    assert study("new", "mine", "--yes") == 2
    assert "the workflow is not installed: clone the repository" in capsys.readouterr().err
    new_study.default_study.cache_clear()
