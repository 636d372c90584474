"""Lenses built in simulation: their rows, their checkpoint, lenses without light, and the table of all designs."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pandas
import pytest
import torch
from examples import f64, read_rows
from rules import finish
from studies import tiny_study
from tolerance_examples import doublet, grade

from tasklens.camera.imaging import PsfCamera
from tasklens.design import production
from tasklens.design.production import Production
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.lens import Lens
from tasklens.optics.tolerancing.manufacturing_errors import draw, errors
from tasklens.optics.tolerancing.sensitivity import displacements
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.settings.tolerance_settings import Grade
from tasklens.show import tolerance_page
from tasklens.study.loading import parse
from tasklens.study.report import tolerances
from tasklens.study.run.outcome import outcome

LABELS = torch.arange(6) % 2
NOISE = torch.rand(6, 3, 40, 40, generator=torch.Generator().manual_seed(0)) - 0.5
IMAGES = 0.5 + NOISE * torch.where(LABELS == 1, 1.0, 0.5)[:, None, None, None], LABELS


def contrast(captures: torch.Tensor) -> torch.Tensor:
    """Logits of a classifier that tells images of high contrast, unless their captures are much blurred."""
    deviation = captures.flatten(1).std(-1)
    return torch.stack([0 * deviation, 100 * (deviation - 0.062)], -1)


def production_of(tolerances: Grade, lens: Lens | None = None) -> Production:
    doublet_lens, view = doublet()
    lens = doublet_lens if lens is None else lens

    def pipeline(built: Lens) -> CapturePipeline:
        return CapturePipeline(PsfCamera(evaluation_psf(built, view, production.RAYS)))

    return Production(lens, view, errors(lens, tolerances), pipeline, contrast)


def test_the_design_comes_first_and_errors_cost_sharpness():
    """Rows are those of lenses built by hand; the same seed gives the same lenses."""
    process = production_of(Grade.model_validate("commercial_moulding"))
    rows = production.built_lenses(process, 6, 5, IMAGES)
    assert [row["lens"] for row in rows] == ["design", *range(6)] and rows[0]["focus_um"] == 0.0
    assert rows[0] | {"lens": 0} == {"lens": 0} | process.measure(process.lens, IMAGES) | {"focus_um": 0.0}
    assert sum(row["rms_spot_um"] for row in rows[1:]) / 6 > rows[0]["rms_spot_um"]
    assert rows[:3] == production.built_lenses(process, 2, 5, IMAGES)
    assert rows[1:3] != production.built_lenses(process, 2, 6, IMAGES)[1:]
    assert not any(row["failed"] for row in rows)


def test_a_production_goes_on_where_it_was_killed(tmp_path, monkeypatch):
    process = production_of(grade(radius_percent=1.0, thickness_um=30.0))
    whole = production.built_lenses(process, 4, 5, IMAGES)
    monkeypatch.setattr("tasklens.runtime.checkpoints.INTERVAL", 0.0)
    measured = []
    measure = Production.measure

    def killed(self, lens, images):
        if len(measured) == 3:
            raise KeyboardInterrupt
        measured.append(lens)
        return measure(self, lens, images)

    monkeypatch.setattr(Production, "measure", killed)
    with pytest.raises(KeyboardInterrupt):
        production.built_lenses(process, 4, 5, IMAGES, Checkpoint(tmp_path / "half.ckpt"))
    monkeypatch.setattr(Production, "measure", lambda *arguments: measured.append(arguments) or measure(*arguments))
    assert production.built_lenses(process, 4, 5, IMAGES, Checkpoint(tmp_path / "half.ckpt")) == whole
    assert len(measured) == 5  # the design and four lenses, each once


@pytest.mark.parametrize("kills", [4, 10])  # of 6 measurements of errors, and of 2 in each trial
def test_errors_and_allotted_tolerances_go_on_where_they_were_killed(tmp_path, monkeypatch, kills):
    """With the same numbers, and at most the measurements of one error or trial twice."""
    process = production_of(grade(radius_percent=1.0, thickness_um=30.0))
    displacement_um = displacements(process.lens, process.view, process.errors, 64)
    monkeypatch.setattr("tasklens.runtime.checkpoints.INTERVAL", 0.0)
    monkeypatch.setattr("tasklens.optics.tolerancing.monte_carlo.YIELD", 0.5)  # of two lenses, one
    accuracy, calls, last = Production.accuracy, [], [math.inf]

    def counted(self, lens, images):
        if len(calls) == last[0]:
            raise KeyboardInterrupt
        calls.append(lens)
        return accuracy(self, lens, images)

    def measured(checkpoint):
        changes = production.one_at_a_time(process, [0, 5, 2], 80.0, IMAGES, checkpoint)
        return changes, production.widest_tolerances(process, displacement_um, 2, 0, IMAGES, checkpoint).tolist()

    monkeypatch.setattr(Production, "accuracy", counted)
    whole, once = measured(NO_CHECKPOINT), len(calls)
    last[0] = once + kills
    with pytest.raises(KeyboardInterrupt):
        measured(Checkpoint(tmp_path / "half.ckpt"))
    last[0] = math.inf
    assert measured(Checkpoint(tmp_path / "half.ckpt")) == whole
    assert len(calls) - once <= once + 3


def test_a_lens_without_light_is_counted():
    """An aperture that is decentred by more than its width: captures are grey, and the lens has failed."""
    lens = replace(doublet()[0], semi_diameter=f64([0.5, 0.6, 0.6, 0.8, 0.8]))
    process = production_of(grade(element_decentre_um=1000.0), lens)
    rows = production.built_lenses(process, 20, 0, IMAGES)
    failed = [row for row in rows if row["failed"]]
    assert 0 < len(failed) < 20 and not rows[0]["failed"]
    summary = tolerance_page.distribution(rows)
    assert summary["failed_lenses"] == len(failed) and summary["built"] == 20


def test_single_errors_and_allotted_tolerances():
    """A single error has the mean of both signs; with allotted tolerances few lenses lose more than a point."""
    process = production_of(Grade.model_validate("commercial_moulding"))
    at = [error.name for error in process.errors].index("element decentre 1 x")
    nominal = process.measure(process.lens, IMAGES)["accuracy"]
    changes = production.one_at_a_time(process, [at], nominal, IMAGES)
    along = torch.zeros(len(process.errors), dtype=torch.float64)
    along[at] = 1.0
    both = [process.accuracy(process.build(s * along)[0], IMAGES)[0].mean() for s in (1, -1)]
    assert changes == {at: pytest.approx(float(sum(both)) / 2 - nominal)}
    displacement_um = displacements(process.lens, process.view, process.errors, 64)
    allotted = production.widest_tolerances(process, displacement_um, 20, 0, IMAGES)
    assert allotted.min() < 1.0
    samples = draw(process.errors, 12, 11)
    lost = [nominal - process.accuracy(process.build(allotted * z)[0], IMAGES)[0].mean() for z in samples]
    assert sum(points > 1 for points in lost) <= 2


def distribution_of(*accuracies: float) -> list[dict]:
    same = {"worst_field_accuracy": 0.0, "loss": 0.0, "rms_spot_um": 2.0}
    same |= {"mtf_quarter_nyquist": 0.5, "focus_um": 0.0, "failed": 0}
    return [{"lens": k, "accuracy": accuracy, **same} for k, accuracy in enumerate(accuracies)]


def test_yields():
    """For a design with 90 %, 89.0 is within one point and 88.9 is not; 87 is within three."""
    row = tolerance_page.distribution(distribution_of(90.0, 91.0, 89.0, 88.9, 87.0, 80.0))
    assert (row["yield_1"], row["yield_3"]) == (40.0, 80.0)
    assert row["accuracy"] == pytest.approx(87.18) and row["lost"] == pytest.approx(2.82)
    assert row["accuracy_5th"] == pytest.approx(80 + 0.2 * 7)  # a fifth of the way from the worst to the next


def test_the_table_has_means_over_seeds_and_sums_of_lenses(tmp_path):
    paths = {}
    for seed, lost in ((0, 1.0), (1, 3.0)):
        paths["doublet-task", seed] = tmp_path / f"{seed}.csv"
        rows = distribution_of(90.0, 90 - lost, 90 - lost)
        rows[1]["failed"] = 1
        pandas.DataFrame(rows).to_csv(paths["doublet-task", seed], index=False)
    (row,) = tolerances.collect(paths).to_dict("records")
    assert (row["accuracy"], row["lost"], row["yield_1"]) == (88.0, 2.0, 50.0)
    assert (row["failed_lenses"], row["built"], row["seeds"]) == (2, 4, 2)


def test_who_tolerates_more(tmp_path):
    """Differences of losses, paired by lens; five seeds show two points less, one seed suggests them."""
    noise = torch.randn(200, generator=torch.Generator().manual_seed(0)).tolist()
    losses = {"a-task": [1 + v for v in noise], "a-imaging": [3 + v for v in noise], "a-same": [1 - v for v in noise]}
    paths = {}
    for name, lost in losses.items():
        path = tmp_path / f"{name}.csv"
        pandas.DataFrame(distribution_of(90.0, *(90 - v for v in lost))).to_csv(path, index=False)
        paths |= {(name, seed): path for seed in range(5)}
    pairs = [("a-task", "a-imaging"), ("a-task", "a-same")]
    comparison = tolerances.compare(paths, pairs, range(5))
    assert comparison["difference"].tolist() == pytest.approx([-2.0, 2 * sum(noise) / 200])
    assert comparison["verdict"][0] == "tolerates more"
    comparison = tolerances.compare(paths, pairs, [0])
    verdict = "suggests -2.0 points (-2.0 to -2.0 over built lenses, one seed)"
    assert comparison["verdict"].tolist() == [verdict, "undecided"]
    assert comparison["low"][0] == pytest.approx(-2.0) == comparison["high"][0]  # the noise is the same
    assert len(tolerances.compare(paths, [], [0])) == 0


@pytest.mark.slow
def test_a_study_makes_the_table_and_the_page_of_each_lens(here):
    """From the stored lenses, PSFs and classifiers; the page names errors and tolerances for a drawing."""
    config = tiny_study() | {"tolerances": {"lenses": 10, "images": 10, "designs": ["imaging1", "imaging2"]}}
    study = parse(config)
    finish("images", study)
    finish("reference", study, classifier="small")
    for lens in ("singlet-imaging1", "singlet-imaging2"):
        for rule in ("design", "psfs"):
            finish(rule, study, lens=lens, seed=0)
        finish("fine_tune", study, lens=lens, measured_name="small", seed=0)
        paths = finish("production", study, lens=lens, seed=0)
        assert len(read_rows(paths.lenses)) == 11
        message = outcome("production", [*map(str, vars(paths).values())], Path("no.log"))
        assert re.fullmatch(r"accuracy \d+\.\d %, of built lenses \d+\.\d %", message)
        names = [row["error"] for row in read_rows(paths.error_table)]
        assert "radius 1" in names and "element tilt 1 y" in names
        page = Path(paths.page).read_text()
        assert page.startswith(f"# Tolerances of {lens}, seed 0\n") and "10 lenses were built" in page
        assert "precision moulding" in page and "on 10 images" in page
    paths = finish("tolerances_table", study)
    rows = read_rows(paths.csv)
    assert [row["design"] for row in rows] == ["imaging1", "imaging2"] and {row["built"] for row in rows} == {"10"}
    assert "Built lenses" in paths.md.read_text() and "Do task-driven" not in paths.md.read_text()
