"""A published lens, simulated and read by its published network again, gives its published answers."""

from pathlib import Path

import pytest
from reference_files import SHARED

import tasklens
from tasklens.recognition import classifiers, evaluation, folders
from tasklens.recognition.dataset import ImageDataset
from tasklens.report import answers_file
from tasklens.study import loading
from tasklens.study.tables import MeasuredKey

ROOT = Path(__file__).parents[1]
PUBLISHED = ROOT / "docs/results/photographs"


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="needs photographs and weights that we do not distribute")
@pytest.mark.parametrize("lens", ["doublet-tasklens", "doublet-imaging2"])
def test_published_answers_are_reproduced(lens):
    """The first 30 test photographs, three of each class, at nine fields; no answer differed on another processor."""
    study = loading.load(ROOT / "config/photographs.yaml")
    listing = folders.find(SHARED / "data/imagenette", ("true_val",), 30, study.images.seed)
    images = ImageDataset(folders.read_all(listing.files, study.images.size), listing.labels, listing.classes)
    weights = SHARED / "weights/mobilenetv2_100_same_in1k.safetensors"
    network = study.network(study.supervisor).model_copy(update={"weights": weights})
    camera = tasklens.PsfCamera(tasklens.psf(*tasklens.load_lens(PUBLISHED / f"lenses/{lens}.yaml")).float())

    classifier = classifiers.frozen(classifiers.build(network, listing.classes), images.images)
    answers = evaluation.evaluate(classifier, images, evaluation.CapturePipeline(camera)).correct.T

    _, packed = answers_file.read(PUBLISHED / "verdicts.npz")
    published = packed.answers[MeasuredKey(lens, study.supervisor, 0)].iloc[: len(listing)]
    assert [listing.classes[label] for label in listing.labels] == list(published.index.get_level_values("label"))
    assert (answers.numpy() != published.to_numpy(bool)).sum() <= 2
    assert 0.2 < published.to_numpy().mean() < 0.8  # right and wrong answers
