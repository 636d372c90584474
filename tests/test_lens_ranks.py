"""Order of lenses by a network: accuracies, groups and intervals, and the answer in words."""

import numpy
import pandas
import pytest

from tasklens.show import lens_ranks
from tasklens.study.report.ranking_table import sieve


def predictions(count: int, seed: int, *accuracies: float) -> dict[str, pandas.DataFrame]:
    """Independent answers through lenses a, b, .. at two fields."""
    generator = numpy.random.default_rng(seed)
    index = pandas.MultiIndex.from_tuples([(k, "cat") for k in range(count)], names=["image", "label"])
    return {
        chr(ord("a") + k): pandas.DataFrame((generator.random((count, 2)) < p).astype(int), index, ["field0", "field1"])
        for k, p in enumerate(accuracies)
    }


def ranking(correct: dict[str, pandas.DataFrame]) -> pandas.DataFrame:
    return lens_ranks.rank_lenses(correct, correct)


def groups(correct: dict[str, pandas.DataFrame]) -> list[int]:
    return ranking(correct)["group"].tolist()


def test_the_order_is_that_of_the_accuracies():
    """A row with the accuracy and the difference to the first lens."""
    correct = predictions(400, 0, 0.5, 0.9, 0.7)
    table = ranking(correct)
    assert table["lens"].tolist() == ["b", "c", "a"] and table["group"].tolist() == [1, 2, 3]
    for row in table.itertuples():
        assert row.accuracy == pytest.approx(100 * correct[row.lens].to_numpy().mean())
        assert row.accuracy_low < row.accuracy < row.accuracy_high
        assert row.behind == pytest.approx(table["accuracy"][0] - row.accuracy)
    assert (table.loc[0, ["behind", "behind_low", "behind_high"]] == 0).all()
    assert table["behind_low"][2] < table["behind"][2] < table["behind_high"][2]


def test_equal_lenses_are_in_one_group():
    """In at least 17 of 20 draws, twenty equally good lenses are in one group: 5 % are split wrongly."""
    split = [max(groups(predictions(200, seed, *20 * [0.8]))) > 1 for seed in range(20)]
    assert sum(split) <= 3


def test_a_much_better_lens_is_alone_among_a_hundred():
    """Also if it classifies every photograph correctly, and the others none."""
    assert groups(predictions(100, 0, 0.99, *99 * [0.2])).count(1) == 1
    assert groups(predictions(50, 0, 1.0, 0.0)) == [1, 2]


def test_few_photographs_do_not_make_a_lens_perfect():
    """Ten of ten right: the accuracy is above 69 %, by the binomial distribution; the difference is as uncertain."""
    table = ranking(predictions(10, 0, 1.0, 1.0))
    assert table["accuracy_low"].tolist() == pytest.approx([69.15] * 2, abs=0.01) and table["accuracy_high"][0] == 100
    assert table["behind_high"][1] == pytest.approx(30.85, abs=0.01) == -table["behind_low"][1]
    (sentence,) = lens_ranks.sentences(table[:1])
    assert sentence == "a: 100.0 %, without another lens to compare with."


def test_photographs_that_all_agree_are_few():
    """In each of 8 photographs the second lens misses one field of 9: the difference may be up to 37 points off."""
    first = pandas.DataFrame(1, index=pandas.MultiIndex.from_product([range(8), ["a"]]), columns=[*"abcdefghi"])
    first.index.names = ["image", "label"]
    _, second = ranking({"a": first, "b": first.assign(i=0)}).itertuples()
    assert second.group == 1
    assert (second.behind_low, second.behind_high) == pytest.approx((11.11 - 36.94, 11.11 + 36.94), abs=0.01)
    _, second = ranking({"a": first.iloc[:3], "b": 0 * first.iloc[:3]}).itertuples()
    assert second.behind_high == 100 and second.behind_low == pytest.approx(29.24, abs=0.01)
    many = pandas.concat([first.rename(index=lambda k, c=copy: 8 * c + k, level=0) for copy in range(9)])
    assert groups({"a": many, "b": many.assign(i=0)}) == [1, 2]


def test_differences_are_of_the_same_photographs():
    """A lens that fails in a few photographs more is behind, however different the photographs are."""
    correct = predictions(300, 0, 0.5)
    worse = correct["a"].copy()
    worse.iloc[(worse.sum(axis=1) == 2).to_numpy().nonzero()[0][:12]] = 0
    table = ranking({**correct, "b": worse})
    assert table["group"].tolist() == [1, 2]
    widths = [table[f"{name}_high"][1] - table[f"{name}_low"][1] for name in ("behind", "accuracy")]
    assert widths[0] < 0.7 * widths[1]


def test_the_columns_of_axis_and_corner_are_those_of_the_nine_fields():
    """The accuracy is that of the 16 fields between them."""
    between, at_nine = (pandas.DataFrame(rows) for rows in ([[1, 0]] * 2, [[1] * 8 + [0], [1] * 4 + [0] * 5]))
    (row,) = lens_ranks.rank_lenses({"a": between}, {"a": at_nine}).itertuples()
    assert (row.accuracy_axis, row.accuracy_corner) == (100.0, 0.0)
    assert row.accuracy_at_nine == pytest.approx(100 * 12 / 18) and row.accuracy == 50


COLUMNS = ["lens", "group", "accuracy", "behind_low", "behind_high"]


def test_the_answer_in_words():
    table = pandas.DataFrame([("A", 1, 90, 0, 0), ("B", 1, 89.5, -0.2, 1.2), ("c", 2, 85, 4, 7)], columns=COLUMNS)
    assert lens_ranks.sentences(table) == [
        "A and B cannot be distinguished by these photographs: they agree within 1.2 points.",
        "c: 4.0 to 7.0 points behind the first.",
    ]
    assert lens_ranks.sentences(table.iloc[[0, 2]])[0] == "A is the best."


def test_what_the_sieve_may_have_missed():
    """A lens with a lower MTF was better by 5 points; the measured lens with the lowest MTF is 20 behind, then 3."""
    mtf = {"a": 0.9, "b": 0.8, "c": 0.5, "left": 0.4, "out": 0.3}
    table = pandas.DataFrame({"lens": [*"bac"], "accuracy": [90, 85, 70]})
    sentence = sieve(table, mtf, ["left", "out"])
    assert "Not measured: 2 lenses with a mean MTF of at most 0.40" in sentence and "by at most 5.0 points" in sentence
    assert "20.0 points behind the first" in sentence and "would be a surprise" in sentence
    assert "cannot be excluded" in sieve(table.assign(accuracy=[90, 85, 87]), mtf, ["left", "out"])
    assert sieve(table, mtf, []) is None
    assert "all have one accuracy" in sieve(table.assign(accuracy=90), mtf, ["out"])
