"""The page of a study: its sentences about verdicts, marked values and missing results."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy
import pandas
import pytest
from examples import write
from rules import workflow
from safetensors.numpy import save_file

from tasklens.runtime.files import read_table
from tasklens.show import publish
from tasklens.show.optimality import Optimum
from tasklens.study.claims import (
    FEWER_ELEMENTS,
    OVER_END_TO_END,
    OVER_IMAGE_QUALITY,
    OVER_IMAGING1,
    OVER_LEAST_SQUARES,
    PAPER_CLAIMS,
)
from tasklens.study.report.page import assembly, page_captures, page_charts, page_tables, words
from tasklens.study.report.verdicts import verdict

KNOWN = 0.001  # p-value of a difference that is significant
MARGINS = {OVER_END_TO_END: 0.5}


def row(claim=OVER_IMAGE_QUALITY, difference=2.0, low=1.0, high=3.0, p=KNOWN, seeds=5, **changes) -> dict:
    """A row of the table of verdicts."""
    decision, reason = verdict(difference, low, high, p, seeds, MARGINS.get(claim, 0.0))
    keys = {"table": "table1", "claim": claim, "lens": "doublet-tasklens", "baseline": "doublet-image_error"}
    values = {"difference": difference, "low": low, "high": high, "p_holm": p, "seeds": seeds}
    return keys | {"classifier": "small"} | values | {"verdict": decision, "reason": reason} | changes


HOLDS, SUGGESTED = row(), row(seeds=1)
AGAINST = row(difference=-2.0, low=-3.0, high=-1.0, seeds=1)
UNDECIDED = row(difference=0.3, low=-1.0, high=1.5, p=0.4)
WITHIN = row(OVER_END_TO_END, difference=-0.2, low=-0.4, high=-0.1, seeds=1)  # of the margin of half a point
BEYOND = row(OVER_END_TO_END, difference=-2.0, low=-3.0, high=-1.0, seeds=1)


@pytest.mark.parametrize(
    "verdict_row, direction, certainty, sentence",
    [
        (HOLDS, words.FOR, words.SHOWN, "Shown: tasklens +2.0 points (+1.0 to +3.0)"),
        (SUGGESTED, words.FOR, words.SUGGESTED, "Suggested: tasklens +2.0 points (+1.0 to +3.0)"),
        (WITHIN, words.FOR, words.SUGGESTED, "Suggested: tasklens −0.2 points (−0.4 to −0.1)"),
        (BEYOND, words.AGAINST, words.SUGGESTED, "Suggested: tasklens −2.0 points (−3.0 to −1.0)"),
        (row(difference=1.04), words.FOR, words.SHOWN, "Shown: tasklens +1.0 point (+1.0 to +3.0)"),
        (UNDECIDED, words.UNDECIDED, words.UNDECIDED, "Undecided: tasklens +0.3 points (−1.0 to +1.5)"),
        (row(FEWER_ELEMENTS, baseline="triplet-imaging2"), words.FOR, words.SHOWN,
         "Shown: tasklens +2.0 points (+1.0 to +3.0) compared with triplet-imaging2, the best imaging lens with more"),
    ],
)  # fmt: skip
def test_a_comparison_in_words(verdict_row, direction, certainty, sentence):
    margin = MARGINS.get(verdict_row["claim"], 0.0)
    assert words.direction_and_certainty(verdict_row, margin) == (direction, certainty)
    assert words.comparison(verdict_row, margin).text.startswith(sentence)


def settings(seeds: int = 5) -> SimpleNamespace:
    """Settings of the page that the sentences read."""
    by_task = ("doublet-tasklens", "doublet-tasklens_joint", "triplet-tasklens")
    return SimpleNamespace(
        by_task=by_task,
        elements={lens: lens.partition("-")[0] for lens in by_task},
        margins=MARGINS,
        questions=(OVER_IMAGE_QUALITY, OVER_LEAST_SQUARES),
        paper_claims=PAPER_CLAIMS,
        seeds=tuple(range(seeds)),
    )


def test_the_summary_gives_the_gain_of_the_first_task_driven_lens_of_each_elements():
    """Compared with lenses for image quality; with least squares if the study has none of these."""
    joint = row(lens="doublet-tasklens_joint", difference=4.0)
    triplet = row(lens="triplet-tasklens", baseline="triplet-image_error", difference=0.3, low=-1.0, high=1.5, p=0.4)
    rows = pandas.DataFrame([joint, HOLDS, triplet, row(OVER_LEAST_SQUARES, difference=9.0)])
    first = words.summary(rows, settings())[0]
    assert first.text == (
        "Accuracy compared with the best lens for image quality (chosen on minival images): "
        "doublet tasklens +2.0 points (+1.0 to +3.0) compared with image_error, shown; "
        "triplet tasklens +0.3 points (−1.0 to +1.5) compared with image_error, undecided."
    )
    first = words.summary(rows[rows["claim"] == OVER_LEAST_SQUARES], settings())[0]
    assert first.text.startswith("Accuracy compared with the best lens by least squares (chosen on minival images): ")


def test_the_papers_claims_are_counted_as_the_paper_has_them():
    """Comparisons with several lenses or networks are one claim; what the paper does not claim is no claim of it."""
    rows = [row(OVER_IMAGING1), row(OVER_LEAST_SQUARES), HOLDS, row(FEWER_ELEMENTS, difference=-2, low=-3, high=-1)]
    rows += [row(OVER_LEAST_SQUARES, table="table2"), UNDECIDED | {"table": "table2", "claim": OVER_IMAGING1}]
    verdicts = pandas.DataFrame(rows)
    counted = {tally.sentence: tally for tally in words.tallies(verdicts, PAPER_CLAIMS, MARGINS)}
    assert [tally.directions.total() for tally in counted.values()] == [2, 1, 2, 1]
    assert [tally.outcome for tally in counted.values()] == [words.FOR, words.AGAINST, words.UNDECIDED, words.FOR]
    assert [tally.of_the_paper for tally in counted.values()] == [True, True, True, False]
    second = words.summary(verdicts, settings())[1]
    counts = "1 is supported by every comparison, 1 is mixed or undecided and 1 is contradicted by every comparison"
    assert second.text == f"Of the paper's 3 claims tested here, {counts}."


@pytest.mark.parametrize(
    "seeds, sentence, over",
    [
        (1, "One seed can only suggest a difference", "over test images."),
        (3, "3 seeds can only suggest a difference", "over test images and seeds."),
        (5, "Intervals are 95 %", "over test images and 5 seeds;"),
    ],
)
def test_the_summary_ends_with_its_certainty(seeds, sentence, over):
    last = words.summary(pandas.DataFrame([SUGGESTED, AGAINST, WITHIN]), settings(seeds))[-1]
    assert last.text.startswith(sentence) and over in last.text


def test_a_study_without_claims_says_so():
    (sentence,) = words.summary(pandas.DataFrame(columns=list(HOLDS)), settings())
    assert sentence.text == "The paper's claims are about no lenses of this study."


def test_a_network_near_chance_is_a_warning():
    """Below a tenth of the way from chance to 100 %, on images without a lens."""
    columns = {"classifier": ["good", "bad", ""], "reference_accuracy": [90.0, 20.0, None], "chance": 12.5}
    (warning,) = words.chance({"table1": pandas.DataFrame(columns)})
    assert warning.text.startswith("Warning: bad recognises 20.0 % of the sharp images; chance is 12.5 %.")


def test_answers_are_about_table_1_by_elements_in_the_order_of_the_questions():
    triplet = row(lens="triplet-tasklens", baseline="triplet-imaging2")
    rows = pandas.DataFrame([row(OVER_LEAST_SQUARES), row(), row(table="table2"), triplet, row(OVER_END_TO_END)])
    answers = words.answers(rows, ["doublet", "triplet", "singlet"], [OVER_IMAGE_QUALITY, OVER_LEAST_SQUARES], MARGINS)
    assert {name: len(sentences) for name, sentences in answers.items()} == {"doublet": 2, "triplet": 1}
    baselines = [sentence.text.rpartition(", ")[2] for sentence in answers["doublet"]]
    assert baselines == ["the best lens for image quality.", "the best lens by least squares."]


def test_convergence_names_what_has_not_converged():
    tests = {"a": Optimum(0.01, 0.01, 0.3, "gradient", 48), "c": Optimum(0.25, 0.01, 0.3, "gradient", 48)}
    first, second = words.convergence(tests)
    assert first.text.startswith("Converged: a. No small step within the limits") and first.direction == words.FOR
    assert second.text.startswith("Not converged: a step of 0.3 um within the limits lowers the loss of c by 0.2500")
    assert second.direction == words.AGAINST


def test_optional_tables_are_known_by_the_names_of_their_files():
    """Each has a caption; another name would be taken for an ablation, and its chart left out."""
    rules = [workflow().get_rule(f"{name}_table") for name in ("merit_function", "tolerances", "tasks")]
    files = [Path(str(path)) for rule in rules for path in rule.output if str(path).endswith(".csv")]
    assert len(files) == 4 and {*map(assembly.table_name, files)} <= set(publish.TITLES)


TABLE = pandas.DataFrame(
    {
        "elements": ["", "doublet", "doublet", "doublet", "triplet"],
        "design": ["reference", "tasklens", "imaging1", "imaging2", "imaging1"],
        "accuracy": [90.0, 71.04, 71.0, 65.0, 60.0],
        "accuracy_paper": [75.6, 70.1, None, None, None],
        "rms_spot_um": [None, 12.0, 9.0, 10.0, 3.0],
        "worst_margin": [None, 0.01, -0.02, 0.0, 0.01],
        "failed": [None, 0.0, 0.0, 0.2, 1.0],
        "accuracy_std": [0.5, 1.4, 0.2, None, 0.1],
    }
)


def cells(table: page_tables.Table, heading: str, paper: bool = False) -> list[page_tables.Cell]:
    """The cells of a column."""
    index = [(column.heading.words, column.paper) for column in table.columns].index((heading, paper))
    return [row[index] for row in table.rows]


def test_a_table_marks_the_best_and_violated_limits():
    """Values equal after rounding tie; sharp images and a lens without competitors are never the best."""
    table = page_tables.build("table1", "Table 1", TABLE)
    assert [cell.best for cell in cells(table, "accuracy")] == [False, True, True, False, False]
    assert [cell.best for cell in cells(table, "RMS spot")] == [False, False, True, False, False]  # the least
    assert [cell.wrong for cell in cells(table, "worst margin")] == [False, False, True, False, False]


def test_a_table_has_spreads_beside_means_and_the_papers_columns_last():
    table = page_tables.build("table1", "Table 1", TABLE)
    texts = [cell.text for cell in cells(table, "accuracy")]
    assert texts[:4] == ["90.0 ± 0.5", "71.0 ± 1.4", "71.0 ± 0.2", "65.0"]
    assert [cell.text for cell in cells(table, "failed")][1:] == ["0", "0", "20", "100"]  # % of the seeds
    assert [column.paper for column in table.columns] == [False] * (len(table.columns) - 1) + [True]
    assert [cell.text for cell in cells(table, "accuracy", paper=True)][1:3] == ["70.1", "–"]


def test_a_chart_has_a_point_per_lens_and_names_the_most_accurate():
    chart = page_charts.accuracy_over_rms(TABLE)
    assert chart is not None and "for 4 lenses. Most accurate: doublet tasklens, 71.0 % at 12.0 um" in chart.words
    assert page_charts.accuracy_over_rms(TABLE[:1]) is None  # sharp images only


def test_accuracy_by_radius_is_a_line_per_design_from_axis_to_corner():
    """Mean over seeds, of the designs of one name of elements; dotted lines where designs see; None without fields."""
    rows = {"elements": ["", "doublet", "doublet", "triplet"], "design": ["reference", "task", "task", "task"]}
    rows |= {"accuracy_field0": [None, 80.0, 70.0, 98.0], "accuracy_field1": [None, 90.0, 94.0, 99.0]}
    chart = page_charts.accuracy_by_radius("doublet", pandas.DataFrame(rows), (0.875, 0.125), ())
    (line,) = json.loads(chart.json)["data"]
    assert (line["name"], line["x"], line["y"]) == ("task", [0.125, 0.875], [92.0, 75.0])
    assert "Farthest out: task 75.0. Designs see fields drawn over the whole sensor." in chart.words
    corner = pandas.DataFrame(rows | {"corner_accuracy": [None, 60.0, 50.0, 90.0]})
    chart = page_charts.accuracy_by_radius("doublet", corner, (0.875, 0.125), (0.0, 0.5, 0.5, 1.0))
    content = json.loads(chart.json)
    assert (content["data"][0]["x"][-1], content["data"][0]["y"][-1]) == (1.0, 55.0)
    assert [line["x0"] for line in content["layout"]["shapes"]] == [0.0, 0.5, 1.0]
    assert "Farthest out: task 55.0. Dotted: fields that designs see." in chart.words
    assert page_charts.accuracy_by_radius("doublet", TABLE, (0.125, 0.875), ()) is None


def test_a_class_may_be_called_by_a_number(tmp_path):
    """Answers are texts: 7 is 7, and 007 is not."""
    image = numpy.full((1, 1, 3, 4, 4), 128, dtype=numpy.uint8)
    save_file({"sharp": image, "lens": image}, tmp_path / "images.safetensors")
    head = "image,label,lens,field,restored,classifier,answer,probability,psnr_db\n"
    rows = "3,7,sharp,,False,a,7,90.0,\n3,7,lens,axis,False,a,7,80.0,20\n3,7,lens,axis,False,b,007,80.0,20\n"
    write(tmp_path / "answers.csv", head + rows)
    (example,) = page_captures.read(tmp_path / "images.safetensors", tmp_path / "answers.csv", "a")
    assert [answer["right"] for answer in example["captures"]["lens", False][0]["answers"]] == [True, False]
    assert example["label"] == "7"


def test_names_may_look_like_numbers(tmp_path):
    """A study may call its elements `2` and a design `nan`; the sharp images have no elements."""
    write(tmp_path / "table1.csv", "elements,design,accuracy\n,reference,99\n2,nan,80\n2,01,70\n")
    table = read_table(tmp_path / "table1.csv")
    assert table["elements"].tolist() == ["", "2", "2"] and table["design"].tolist() == ["reference", "nan", "01"]
    (sentence,) = words.best_lenses(table, ["2-nan"]).values()
    assert sentence.text.startswith("nan, the most accurate task-driven design: 80.0 %; 01, the most accurate other")
