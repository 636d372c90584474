"""The figure of the answer, and files of answers from which verdicts are recomputed."""

import re

import pandas
import pytest
from random_answers import claim, random_answers

from tasklens.runtime.files import FileError
from tasklens.study.claims import FLAT_FAILS, OVER_IMAGING1, Claims
from tasklens.study.report import answer, answers_file, verdicts

CLAIMS = Claims(
    study="known",
    claims=(claim(OVER_IMAGING1, "doublet-task", "doublet-a", "doublet-imaging1"), claim(FLAT_FAILS, "doublet-flat")),
    seeds=(0, 1, 2),
)


def test_verdicts_from_a_file_of_answers_are_those_of_the_measurements(tmp_path):
    """Of several baselines, and of a design that fails; to the last digit, also the claims themselves."""
    measurements, path = random_answers(CLAIMS), tmp_path / "verdicts.npz"
    answers_file.write(path, CLAIMS, measurements)
    claims, packed = answers_file.read(path)
    assert claims == CLAIMS
    pandas.testing.assert_frame_equal(verdicts.collect(claims, packed), verdicts.collect(CLAIMS, measurements))
    assert path.stat().st_size < 4000  # 12 lenses and seeds, 50 images, 9 fields: a bit each


def test_a_study_without_claims_has_a_file(tmp_path):
    none = Claims(study="known", claims=(), seeds=(0,))
    answers_file.write(tmp_path / "verdicts.npz", none, random_answers(none))
    assert answers_file.read(tmp_path / "verdicts.npz")[0] == none


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and nothing more", b"text"])
def test_a_damaged_file_of_answers_is_named(tmp_path, content):
    path = tmp_path / "verdicts.npz"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"verdicts\.npz: no packed answers .*; delete it and run again"):
        answers_file.read(path)


def test_the_figure_of_the_answer_has_every_comparison_and_design(tmp_path):
    """Names of designs and comparisons are text; undecided ones are grey; the same data give the same file."""
    text = "more accurate than the best one"
    rows = [
        ("doublet-task", "doublet-psnr", text, 1.0, 0.5, 1.5, "holds"),
        ("doublet-task", "triplet-psnr", text, -1.0, -1.5, -0.5, "does not hold"),
        ("doublet-task", "doublet-psnr (2), doublet-error (1)", text, 1.0, 0.5, 1.5, "undecided"),
    ]
    comparisons = pandas.DataFrame(rows, columns=["lens", "baseline", "claim", "difference", "low", "high", "verdict"])
    columns = {"elements": ["doublet"] * 3 + ["triplet"], "design": ["task", "psnr", "task", "psnr"]}
    accuracies = pandas.DataFrame(columns | {"accuracy": [98.0, 97.0, 100.0, 99.0]})
    for name in ("a.svg", "b.svg"):
        answer.draw(tmp_path / name, comparisons, accuracies, ["doublet-task"], 99.9)
    text = (tmp_path / "a.svg").read_text()
    labels = re.findall(r">([^<>]+)</text>", text)
    assert {"task − psnr", "task − triplet-psnr", "task − the best one"} <= {*labels}
    assert {"doublet", "triplet", "task", "psnr"} <= {*labels}
    assert text == (tmp_path / "b.svg").read_text()
    with_the_intervals = re.findall(r"stroke: (#[0-9a-f]{6}); stroke-width: 2", text)
    assert with_the_intervals[:3] == ["#0072b2", "#d55e00", "#777777"]
