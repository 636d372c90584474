"""Other photographs through the lenses of a study: accuracies, and the advantage of one lens."""

import importlib
from pathlib import Path

import numpy
import pandas
import pytest
import timm
import torch
from examples import changed, lens_file, tiny_study, write
from PIL import Image

from tasklens.optics.io import psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.runtime.files import write_tensors
from tasklens.study import loading

CLASSES = {"n01440764": 0, "n01443537": 1, "n02102040": 217}


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    return importlib.import_module("other_photographs")


def photographs(folder: Path) -> None:
    """Three grey images a class, brighter from class to class, with a little noise."""
    random = numpy.random.default_rng(0)
    for k, name in enumerate(CLASSES):
        (folder / name).mkdir(parents=True)
        for i in range(3):
            pixels = (40 + 80 * k + random.integers(0, 8, (16, 16, 3))).astype("uint8")
            Image.fromarray(pixels).save(folder / name / f"{i}.png")


def test_a_perfect_lens_is_read_as_sharp_photographs_are(script, tmp_path, monkeypatch, capsys):
    """A PSF of one point changes no answer. Lenses without files are left out."""
    monkeypatch.chdir(tmp_path)
    photographs(tmp_path / "others")
    config = changed(tiny_study(), "classifiers.small.outputs", "all_imagenet")
    write(Path("study.yaml"), loading.dump(study := loading.parse(config)))
    torch.manual_seed(0)
    network = timm.create_model("test_resnet", num_classes=1000)
    weights = Path("results/tiny/classifiers/reference/small.safetensors")
    weights.parent.mkdir(parents=True)
    write_tensors(weights, network.state_dict(), {})
    for design, light in (("tasklens", 1.0), ("imaging2", 0.0)):
        psf = torch.zeros(9, 3, 11, 11)
        psf[:, :, 5, 5] = light
        path = lens_file("tiny", f"singlet-{design}", name="psf.safetensors")
        path.parent.mkdir(parents=True)
        psf_files.write(path, FieldPsfs(psf, torch.ones(9)), {"fields_mm": [[0, 0]] * 9})
    by_lens = script.accuracies(study, Path("others"), ["singlet-tasklens", "singlet-imaging1", "singlet-imaging2"])
    assert list(by_lens) == ["sharp", "singlet-tasklens", "singlet-imaging2"]
    assert all(frame.shape == (9, 1) for frame in by_lens.values())
    numpy.testing.assert_array_equal(by_lens["sharp"], by_lens["singlet-tasklens"])
    script.main(["study.yaml", "others", "--designs", "tasklens", "imaging2"])
    assert "| singlet-imaging2 | 1 |" in capsys.readouterr().out


def test_the_advantage_is_that_over_the_other_lens(script):
    """Two seeds with 10 and 14 points more give 12; one seed with equal differences gives an interval of no width."""
    other = pandas.DataFrame({0: numpy.linspace(0, 60, 40), 1: numpy.linspace(10, 70, 40)})
    by_lens = {"sharp": other[[0]], "doublet-task": other.add([10, 14]), "doublet-plain": other, "triplet-plain": other}
    rows = {row[0]: row for row in script.rows(by_lens, "task")}
    assert rows["doublet-plain"][:3] == ("doublet-plain", 2, "35.0 ± 7.1")
    assert rows["doublet-plain"][3].startswith("+12.0 (") and rows["sharp"][3] == rows["triplet-plain"][3] == ""
    one = {lens: frame[[0]] for lens, frame in by_lens.items()}
    assert script.rows(one, "task")[2] == ("doublet-plain", 1, "30.0", "+10.0 (+10.0 to +10.0)")
