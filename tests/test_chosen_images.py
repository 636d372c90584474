"""The images that a report shows: chosen by a rule from constructed predictions."""

import pandas
import pytest

from tasklens.runtime.files import FileError
from tasklens.settings.names import SHARP
from tasklens.study.jobs.capture import choose

LABELS = ["cat", "dog", "dog", "owl", "fox", "cat"]
CORRECT = {
    SHARP: [[0, 1, 1, 1, 0, 1]],
    "a": [[1] * 6, [1, 1, 1, 1, 1, 0]],
    "b": [[0, 1, 0, 0, 0, 0], [1, 1, 1, 1, 1, 0]],
}


@pytest.fixture
def files(tmp_path):
    for name, fields in CORRECT.items():
        columns = {"image": range(6), "label": LABELS} | {f"field{k}": column for k, column in enumerate(fields)}
        pandas.DataFrame(columns).to_csv(tmp_path / f"{name}.csv", index=False)
    return {name: tmp_path / f"{name}.csv" for name in CORRECT}


def test_the_first_and_those_that_divide_the_lenses_most(files):
    """Only images recognised when sharp, one per label: shares 1 and 0.75 (dogs), 0.75 (owl), 0.25 (second cat)."""
    assert choose(files) == [1, 3, 5]


def test_without_the_sharp_images_all_take_part(files):
    """The first cat and the fox too, with shares of 0.75; among equals, the first image is chosen."""
    del files[SHARP]
    assert choose(files) == [0, 2, 3]


def test_without_a_lens_there_is_nothing_to_choose_by(files):
    with pytest.raises(FileError, match="no lens has been measured"):
        choose({SHARP: files[SHARP]})
