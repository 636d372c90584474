"""A study names its fields: wrong sets are refused, and PSFs are stored at each."""

import itertools
from pathlib import Path

import pytest
import torch
from designs import GRADED, OWN, SELECTED
from examples import lens_and_view
from rules import finish
from studies import changed, lens_file, tiny_study

from tasklens.design.problem import Problem
from tasklens.fields import CORNER, PAPER
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import drawn_points, view_of_spec
from tasklens.runtime.files import FileError, read_tensors
from tasklens.settings.field_settings import FieldSettings
from tasklens.study.loading import parse
from tasklens.study.study import Study, StudyError
from tasklens.study.table_contents import lens_design

LIST = [list(point) for point in OWN]  # as a study file has them


def small(**keys) -> Study:
    """The small study with other keys."""
    return parse({"extends": "small", "name": "mine", **keys})


ALL_BUT_ONE = [[0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5]]


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"design": "nine"}, "fields.design = 'nine': expected sensor or paper"),
        ({"design": [[0, 0], [1, 1], [0.5, 0.5]]}, "expected at least 4 fields, found 3"),
        ({"design": [*ALL_BUT_ONE, [1.2, 1]]}, "expected sensor or paper, or a list of [x, y]"),
        ({"design": [*ALL_BUT_ONE, [0.7, 0.7]]}, "fields.design: the set misses the corner by 0.15 of the diagonal"),
        ({"design": [[0.3, 0.3], *3 * [[1, 1]]]}, "fields.design: the set misses the axis by 0.15 of the diagonal"),
        ({"grading": [*ALL_BUT_ONE, [0.7, 0.7]]}, "fields.grading: the set misses the corner by 0.15 of the diagonal"),
        ({"design": [[0, 0], [1, 1], *GRADED[:4]]}, "fields.grading: [0.0625, 0.0625] is also a field of"),
        ({"design": "paper", "grading": PAPER}, "fields.grading: [0, 0] is also a field of fields.design"),
        ({"grading": SELECTED}, "is also a field of the choice among lenses"),
        ({"design": "sensor", "gradig": "paper"}, "fields.gradig = 'paper': unknown key; did you mean grading?"),
    ],
)
def test_wrong_fields_are_refused(fields, words):
    with pytest.raises(StudyError) as error:
        small(fields=fields)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_fields_of_a_variant_are_checked_too():
    """They may not be those of the grading, nor the study's own, which change nothing."""

    def variant(fields) -> dict:
        return {"fields": {"elements": "doublet", "design": "tasklens", "variants": {"other": {"fields": fields}}}}

    assert small(ablations=variant("paper")).design_points("doublet-tasklens_fields_other") == PAPER
    for fields, words in (
        (GRADED, "is also a field of ablations.fields.variants.other.fields"),
        (ALL_BUT_ONE, "ablations.fields.variants.other.fields: the set misses the corner"),
        (OWN[:3], "expected at least 4 fields, found 3"),
        ("sensor", "ablations.fields.variants.other: has the same values as the design itself"),
    ):
        with pytest.raises(StudyError) as error:
            small(ablations=variant(fields))
        assert words in str(error.value) and "\n" not in str(error.value)


def test_metrics_of_each_set():
    """Designs for some fields are graded there, too; if the nine are all there is, not twice."""
    default, paper = FieldSettings(), FieldSettings.model_validate("paper")
    assert default.grading_sets(None) == {"accuracy": "grading", "corner_accuracy": "corner"}
    assert default.grading_sets(PAPER)["accuracy_at_design_fields"] == "nine"
    assert default.grading_sets(OWN)["accuracy_at_design_fields"] == "design" and default.sets(OWN)["design"] == (OWN,)
    assert FieldSettings(nine=True).grading_sets(None)["accuracy_at_nine"] == "nine"
    assert paper.grading_sets(PAPER) == {"accuracy": "grading", "corner_accuracy": "corner"}
    for settings, design in itertools.product((default, paper, FieldSettings(nine=True)), (None, PAPER, OWN)):
        assert {*settings.grading_sets(design).values()} <= {*settings.sets(design)}


def test_the_papers_fields_are_those_of_the_specification():
    """Bit for bit, in each step and in validation, whatever the seed."""
    study = small(fields="paper")
    plan = lens_design(study, "doublet-tasklens", 0)
    assert plan.fields == plan.averaged == PAPER and study.fields.grading_points == PAPER
    view = view_of_spec(study.spec)
    posed = Problem(view, study.constraints, 0, fields=plan.fields)
    for seed in (0, 7):
        assert torch.equal(posed.view_of_step(seed).fields, view.fields)
    (validated,) = posed.views_of_validation
    assert torch.equal(validated.fields, view.fields)
    assert lens_design(small(), "doublet-tasklens", 0).fields is None


def stored(study: Study, lens: str = "singlet-imaging1") -> tuple[Lens, Path]:
    """Two random elements in place of a lens of the study, and the file of their PSFs."""
    path = lens_file(study.name, lens)
    path.parent.mkdir(parents=True, exist_ok=True)
    prescription.write(path, Prescription(lens_and_view()[0]), {})
    return prescription.read(path)[0].lens, finish("psfs", study, lens=lens, seed=0).psf


def test_stored_psfs_are_those_traced_at_their_fields(here):
    """Of every set; the fields of training are draws by the seed."""
    study = parse(changed(tiny_study(), "fields.design", LIST))
    lens, path = stored(study)
    view = view_of_spec(study.spec)
    sets = {"selection": SELECTED, "grading": GRADED, "nine": PAPER, "corner": CORNER, "design": OWN}
    for name, points in {**sets, "training": drawn_points(8, seed=0)}.items():
        psf, illumination, turns = psf_files.read(path, name)
        seen = view.at(points)
        assert (psf - evaluation_psf(lens, seen, study.evaluation_rays)).abs().max() < 1e-6, name
        assert (illumination == 1).all(), name  # there is no sensor
        assert turns == {"training": 8, "selection": 4, "grading": 4}.get(name, 1)
    assert not torch.equal(drawn_points(8, seed=0), drawn_points(8, seed=1))


def test_psfs_of_the_papers_nine_are_stored_once(here):
    study = parse(tiny_study() | {"fields": "paper"})
    _, path = stored(study)
    _, notes = read_tensors(path)
    nine = {name: [0, 9, 1] for name in ("training", "selection", "grading", "nine")}
    assert notes["sets"] == nine | {"corner": [9, 10, 1]} and len(notes["fields_mm"]) == 10
    assert torch.equal(psf_files.read(path, "corner").psf[0], psf_files.read(path, "nine").psf[8])
    with pytest.raises(FileError, match="has no PSFs of the fields of design"):
        psf_files.read(path, "design")
