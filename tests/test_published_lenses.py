"""Published lenses, measured and simulated again, give their published figures, limits and answers."""

from pathlib import Path

import pytest
import yaml
from reference_files import SHARED
from torch.testing import assert_close

import tasklens
from tasklens.design.constraints import all_margins, limit_margins
from tasklens.optics.analysis.datasheet import figures
from tasklens.recognition import classifiers, evaluation, folders
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.specification import Constraints
from tasklens.study import loading
from tasklens.study.report import answers_file
from tasklens.study.table_contents import MeasuredKey

ROOT = Path(__file__).parents[1]
PUBLISHED = ROOT / "docs/results/photographs"
STUDIES = sorted(path.parent.name for path in ROOT.glob("docs/results/*/lenses"))


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_published_figures_and_margins_are_reproduced(study):
    """Of every lens: margins within 1e-9; figures within 5e-4, since another processor may lose other rays of 4096."""
    for path in sorted(ROOT.glob(f"docs/results/{study}/lenses/*.yaml")):
        content = yaml.safe_load(path.read_text())
        lens, view = tasklens.load_lens(path)
        margins_of = limit_margins if "means" in content else all_margins  # 1.0 had them at the nine fields
        margins = margins_of(lens, Constraints(), view, lens.semi_diameter)
        least = {name: float(margins[name].min()) for name in content["margins"]}
        assert least == pytest.approx(content["margins"], abs=1e-9), path.name
        again, published = figures(lens, view, content["figures"]["rays"]), content["figures"]
        assert_close({name: again[name] for name in published}, published, rtol=0, atol=5e-4, check_dtype=False)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="needs photographs and weights that we do not distribute")
@pytest.mark.parametrize("lens", ["doublet-tasklens", "doublet-imaging2"])
def test_published_answers_are_reproduced(lens):
    """The first 30 test photographs, three of each class, at nine fields; no answer differed on another processor."""
    study = loading.load(ROOT / "config/photographs.yaml")
    listing = folders.find(SHARED / "data/imagenette/true_val", 30, study.images.seed)
    images = ImageDataset(folders.read_all(listing.files, study.images.size), listing.labels, listing.classes)
    weights = SHARED / "weights/mobilenetv2_100_same_in1k.safetensors"
    network = study.classifier(study.supervisor).model_copy(update={"weights": weights})
    camera = tasklens.PsfCamera(tasklens.psf(*tasklens.load_lens(PUBLISHED / f"lenses/{lens}.yaml")).float())

    classifier = classifiers.frozen(classifiers.build(network, listing.classes), images.images)
    answers = evaluation.evaluate(classifier, images, evaluation.CapturePipeline(camera)).correct.T

    _, packed = answers_file.read(PUBLISHED / "verdicts.npz")
    published = packed.answers[MeasuredKey(lens, study.supervisor, 0)].iloc[: len(listing)]
    assert [listing.classes[label] for label in listing.labels] == list(published.index.get_level_values("label"))
    assert (answers.numpy() != published.to_numpy(bool)).sum() <= 2
    assert 0.2 < published.to_numpy().mean() < 0.8  # right and wrong answers
