"""Photographs of other classes through the lenses of a study."""

from pathlib import Path

import numpy
import pandas
import pytest
import timm
import torch
from examples import load_script, write
from PIL import Image
from studies import changed, lens_file, tiny_study

from tasklens.optics.io import psf_files
from tasklens.runtime.files import write_tensors
from tasklens.study import loading
from tasklens.study.claims import OVER_LEAST_SQUARES, Claim, Claims
from tasklens.study.report import answers_file
from tasklens.study.report.answers_file import PackedMeasurements

CLASSES = {"n01440764": 0, "n01443537": 1, "n02102040": 217}
KEYS = [(f"singlet-{design}", "small", 0) for design in ("tasklens", "imaging2")]


def photographs(folder: Path) -> None:
    """Three images a class of one mean: bars across, bars along and a chessboard, with a little noise."""
    random = numpy.random.default_rng(0)
    row, column = numpy.indices((16, 16)) // 2
    for name, pattern in zip(CLASSES, (row, column, row + column), strict=True):
        (folder / name).mkdir(parents=True)
        for i in range(3):
            pixels = 60 + 120 * (pattern % 2)[..., None] + random.integers(0, 8, (16, 16, 3))
            Image.fromarray(pixels.astype("uint8")).save(folder / name / f"{i}.png")


def nearest_centroid(folder: Path) -> torch.nn.Module:
    """An untrained network whose last layer names the class with the nearest mean of features."""
    torch.manual_seed(0)
    network = timm.create_model("test_resnet", num_classes=1000).eval()
    mean, std = (torch.tensor(network.default_cfg[key])[:, None, None] for key in ("mean", "std"))
    last = network.get_classifier()
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(-1e9)
        for name, output in CLASSES.items():
            pixels = numpy.stack([numpy.asarray(Image.open(path)) for path in sorted((folder / name).iterdir())])
            images = (torch.from_numpy(pixels).movedim(-1, 1) / 255 - mean) / std
            centroid = network.forward_head(network.forward_features(images), pre_logits=True).mean(0)
            last.weight[output], last.bias[output] = centroid, -centroid.square().sum() / 2
    return network


def test_a_perfect_lens_is_read_as_sharp_photographs_are(here, monkeypatch):
    """A PSF of one point changes no answer; a PSF without light leaves a veil, which says nothing."""
    other_classes = load_script(Path(__file__).parents[1] / "docs/results/other_classes.py")
    monkeypatch.setattr(other_classes, "FOLDER", here / "docs")
    monkeypatch.setattr("sys.argv", ["other_classes.py", "tiny", "others"])
    photographs(here / "others")
    config = changed(tiny_study(), "classifiers.small.outputs", "all_imagenet")
    config = changed(config, "images.folder", str(here / "others"))
    write(Path("results/tiny/study.yaml"), loading.dump(loading.parse(config)))
    weights = Path("results/tiny/classifiers/reference/small.safetensors")
    weights.parent.mkdir(parents=True)
    network = nearest_centroid(here / "others")
    write_tensors(weights, network.state_dict(), {})
    for (lens, _, _), light in zip(KEYS, (1.0, 0.0), strict=True):
        psf = torch.zeros(9, 3, 11, 11)
        psf[:, :, 5, 5] = light
        path = lens_file("tiny", lens, name="psf.safetensors")
        path.parent.mkdir(parents=True)
        psf_files.write(path, psf, torch.ones(9), {"grading": (0, 9, 1)}, {"fields_mm": [[0, 0]] * 9})
    (lens, classifier, _), (baseline, _, _) = KEYS
    compared = {"lens": lens, "baselines": (baseline,), "classifier": classifier, "reference": classifier}
    claim = Claim(table="table1", text=OVER_LEAST_SQUARES, **compared)
    index = pandas.MultiIndex.from_tuples([(0, "a")], names=["image", "label"])
    answers = {key: pandas.DataFrame([[1]], index) for key in KEYS}
    accuracies = {key: {"minival_accuracy": 50.0, "chance": 0.1} for key in KEYS}
    energy = {(lens, seed): 1.0 for lens, _, seed in KEYS}
    of_study = PackedMeasurements({}, {}, answers=answers, accuracies=accuracies, energy=energy)
    claims = Claims(study="tiny", claims=(claim, claim.model_copy(update={"table": "table2"})), seeds=(0,))
    Path("results/tiny/tables").mkdir()
    answers_file.write(Path("results/tiny/tables/verdicts.npz"), claims, of_study)
    other_classes.main()
    folder = Path("docs/tiny/other_classes")
    accuracy = pandas.read_csv(folder / "accuracies.csv").set_index("lens")["accuracy"]
    assert accuracy["sharp"] == pytest.approx(accuracy[lens]) and accuracy[lens] > accuracy[baseline]
    verdict = pandas.read_csv(folder / "verdicts.csv").squeeze()
    assert verdict["difference"] == pytest.approx(accuracy[lens] - accuracy[baseline])
    read, packed = answers_file.read(folder / "verdicts.npz")
    assert read.claims == (claim,) and packed.correct(*KEYS[0]).shape == (9, 9)
    assert {*packed.correct(*KEYS[0]).index.get_level_values("label")} == {*CLASSES}
