"""Tables for people and for programs."""

import math

import pandas
import pytest

from tasklens.show import headings
from tasklens.show.publish import publish

TABLE = pandas.DataFrame(
    {
        "lens": ["a", "b", ""],
        "accuracy": [71.256, math.nan, 60.0],
        "accuracy_std": [1.0, 2.004, 3.0],
        "accuracy_paper": [70.0, math.nan, math.nan],
        "seeds": [5, 5, 1],
        "converged": [True, False, True],
        "note": ["5.0", None, "x"],
        "r2": [0.5, 1.0, 0.123],
    }
)


def test_the_best_of_a_table_is_that_of_its_elements_task_and_score():
    tasks = {"lens": ["doublet-a", "doublet-b"] * 2, "task": "masks", "score": ["ap", "ap", "ap50", "ap50"]}
    table = pandas.DataFrame(tasks | {"tuned": [1.0, 2.0, 4.0, 3.0]})
    assert headings.best(table, "tuned") == [False, True, True, False]
    lenses = ["doublet-a", "doublet-b", "triplet-a", "triplet-b"]
    tails = pandas.DataFrame({"lens": lenses, "core_radius_um": [3.0, 4.0, 2.0, 1.0]})
    assert headings.best(tails, "core_radius_um") == [True, False, False, True]


def test_readers_see_headings_with_units_spreads_and_dashes():
    texts = headings.texts(TABLE)
    assert texts.columns.tolist() == ["lens", "accuracy [%]", "seeds", "converged", "note", "r2", "accuracy [%], paper"]
    assert texts["accuracy [%]"].tolist() == ["71.3 ± 1.0", "–", "60.0 ± 3.0"]
    assert texts["accuracy [%], paper"].tolist() == ["70.0", "–", "–"]
    assert texts["lens"].tolist() == ["a", "b", "–"] and texts["seeds"].tolist() == ["5", "5", "1"]
    assert texts["r2"].tolist() == ["0.50", "1.00", "0.12"]  # a column without a heading
    assert texts["converged"].tolist() == ["True", "False", "True"] and texts["note"].tolist() == ["5.0", "–", "x"]


@pytest.mark.parametrize(
    "name, value, text", [("accuracy", math.inf, "inf"), ("gap", 0.0004, "+0.000"), ("failed", 0.2, "20")]
)
def test_numbers_at_the_edge(name, value, text):
    assert headings.texts(pandas.DataFrame({name: [value]})).iloc[0, 0] == text


def test_a_published_table_has_every_digit_in_csv_and_a_title_and_a_note_in_markdown(tmp_path):
    csv, md = tmp_path / "new" / "sweep.csv", tmp_path / "new" / "sweep.md"
    publish(csv, md, TABLE, "A note.")
    frame = pandas.read_csv(csv)
    assert list(frame) == list(TABLE) and frame["accuracy"].tolist()[::2] == [71.256, 60.0]
    lines = md.read_text().splitlines()
    assert lines[:2] == ["**Sweep**", ""] and lines[-2:] == ["", "A note."]
    body = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert body[0][:2] == ["lens", "accuracy [%]"] and body[2][:3] == ["a", "71.3 ± 1.0", "5"]
    assert body[3][1] == "–" and len(body) == 2 + 3
    assert len(list(csv.parent.iterdir())) == 2


def test_the_markdown_may_show_another_table(tmp_path):
    csv, md = tmp_path / "sweep.csv", tmp_path / "sweep.md"
    publish(csv, md, TABLE, "A note.", TABLE[["lens"]])
    assert list(pandas.read_csv(csv)) == list(TABLE) and "accuracy" not in md.read_text()


def test_an_empty_table_is_a_title_and_a_note(tmp_path):
    """Its CSV has the columns, for programs that read it."""
    csv, md = tmp_path / "ablation_a_b.csv", tmp_path / "t.md"
    publish(csv, md, TABLE.iloc[:0], "Nothing.")
    assert md.read_text() == "**Ablation: a b**\n\nNothing.\n"
    assert list(pandas.read_csv(csv)) == list(TABLE)
