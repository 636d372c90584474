"""Tables for people and for programs."""

import math

import pandas
import pytest

from tasklens.report.publish import publish, rounded

TABLE = pandas.DataFrame(
    {
        "lens": ["a", "b", ""],
        "accuracy": [71.256, math.nan, 60.0],
        "accuracy_std": [1.0, 2.004, 3.0],
        "seeds": [5, 5, 1],
        "converged": [True, False, True],
        "note": ["5.0", None, "x"],
    }
)


def test_numbers_are_rounded_by_the_longest_beginning_of_their_column():
    table = rounded(TABLE, {"": ".1f", "acc": ".2f", "accuracy_std": "+.3f", "seeds": ".0f", "lens": ".9f"})
    assert table["accuracy"].tolist() == ["71.26", "–", "60.00"]
    assert table["accuracy_std"].tolist() == ["+1.000", "+2.004", "+3.000"]
    assert table["seeds"].tolist() == ["5", "5", "1"]


def test_what_is_no_number_stays_and_gaps_are_dashes():
    table = rounded(TABLE, {"": ".1f"})
    assert table["lens"].tolist() == ["a", "b", "–"]
    assert table["converged"].tolist() == [True, False, True]
    assert table["note"].tolist() == ["5.0", "–", "x"]
    assert table.columns.tolist() == TABLE.columns.tolist()


def test_columns_without_a_format_keep_every_digit():
    table = rounded(TABLE, {"accuracy_std": ".1f"})
    assert table["accuracy"].tolist() == [71.256, "–", 60.0] and table["seeds"].tolist() == [5, 5, 1]


@pytest.mark.parametrize("value, shown", [(math.inf, "inf"), (-0.004, "-0.00"), (1e6, "1000000.00"), (math.nan, "–")])
def test_numbers_at_the_edge(value, shown):
    assert rounded(pandas.DataFrame({"x": [value]}), {"": ".2f"})["x"].tolist() == [shown]


def test_rounding_leaves_the_table_as_it_was():
    before = TABLE.copy(deep=True)
    rounded(TABLE, {"": ".0f"})
    pandas.testing.assert_frame_equal(TABLE, before)


def test_a_published_table_has_every_digit_in_csv_and_a_title_and_a_note_in_markdown(tmp_path):
    csv, md = tmp_path / "new" / "t.csv", tmp_path / "new" / "t.md"
    publish(csv, md, "Title", TABLE, rounded(TABLE, {"": ".1f"}), "A note.")
    frame = pandas.read_csv(csv)
    assert list(frame) == list(TABLE) and frame["accuracy"].tolist()[::2] == [71.256, 60.0]
    lines = md.read_text().splitlines()
    assert lines[:2] == ["**Title**", ""] and lines[-2:] == ["", "A note."]
    body = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert body[0] == list(TABLE) and body[2] == ["a", "71.3", "1.0", "5.0", "True", "5.0"]
    assert body[3][1] == "–" and len(body) == 2 + 3
    assert len(list(csv.parent.iterdir())) == 2


def test_an_empty_table_is_a_title_and_a_note(tmp_path):
    """Its CSV has the columns, for programs that read it."""
    csv, md = tmp_path / "t.csv", tmp_path / "t.md"
    empty = TABLE.iloc[:0]
    publish(csv, md, "Title", empty, rounded(empty, {"": ".1f"}), "Nothing.")
    assert md.read_text() == "**Title**\n\nNothing.\n"
    assert list(pandas.read_csv(csv)) == list(TABLE)
