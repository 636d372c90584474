"""Metrics files: their means, and files that are damaged."""

import pytest
from examples import write

from tasklens.recognition.metrics import mean_metrics, worst_field_metrics
from tasklens.runtime.files import FileError

HEAD = "elements,field,metric,value\n"
ROWS = [
    *(f"a,{k},accuracy,{10 * k}\n" for k in range(9)),
    *(f"a,{k},psnr_db,{k}\n" for k in range(9)),
    "a,,chance,10\n",
]


def test_means_are_over_the_fields(tmp_path):
    """0 to 80 in steps of ten; a metric without fields is itself; rows in any order."""
    write(tmp_path / "a.csv", HEAD + "".join(reversed(ROWS)))
    assert mean_metrics(tmp_path / "a.csv") == {"accuracy": 40, "psnr_db": 4, "chance": 10}
    assert worst_field_metrics(tmp_path / "a.csv") == {"accuracy": 0, "psnr_db": 0, "chance": 10}


@pytest.mark.parametrize(
    "text, words",
    [
        (HEAD + "".join(ROWS[1:]), "accuracy has the fields 1, 2, 3, 4, 5, 6, 7, 8;"),
        (HEAD + "".join(ROWS[:8] + ROWS[9:]), "accuracy has the fields 0, 1, 2, 3, 4, 5, 6, 7"),
        (HEAD + "".join([*ROWS, ROWS[3]]), "accuracy has the fields 0, 1, 2, 3, 3, 4"),
        (HEAD + "".join(ROWS).replace("a,3,accuracy,30", "a,3,accuracy,"), "a value is missing"),
        (HEAD + "".join(ROWS).replace("a,3,accuracy,30", "a,3,accuracy,3x"), "not a table of metrics"),
        (HEAD, "a value is missing"),
        ("", "not a table of metrics"),
        ("a,b\n1,2\n", "not a table of metrics"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, text, words):
    write(tmp_path / "a.csv", text)
    with pytest.raises(FileError) as caught:
        mean_metrics(tmp_path / "a.csv")
    assert str(caught.value).startswith(f"{tmp_path}/a.csv: ") and words in str(caught.value)
    assert str(caught.value).endswith("; delete it and run again")
