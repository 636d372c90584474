"""Order of lenses by a network: accuracies, groups and intervals, and the answer in words."""

import numpy
import pandas
import pytest

from tasklens.show import lens_ranks
from tasklens.show.lens_ranks import Rank
from tasklens.study.report.ranking_table import sieve


def predictions(count: int, seed: int, *accuracies: float) -> dict[str, pandas.DataFrame]:
    """Independent answers through lenses a, b, .. at two fields."""
    generator = numpy.random.default_rng(seed)
    index = pandas.MultiIndex.from_tuples([(k, "cat") for k in range(count)], names=["image", "label"])
    return {
        chr(ord("a") + k): pandas.DataFrame((generator.random((count, 2)) < p).astype(int), index, ["field0", "field1"])
        for k, p in enumerate(accuracies)
    }


def test_the_order_is_that_of_the_accuracies():
    """A rank with the accuracy at each field, and the difference to the first lens."""
    correct = predictions(400, 0, 0.5, 0.9, 0.7)
    ranks = lens_ranks.rank_lenses(correct)
    assert [rank.lens for rank in ranks] == ["b", "c", "a"] and [rank.group for rank in ranks] == [1, 2, 3]
    for rank in ranks:
        assert rank.accuracy == pytest.approx(100 * correct[rank.lens].to_numpy().mean())
        assert rank.by_field == pytest.approx((100 * correct[rank.lens].mean()).tolist())
        assert rank.low < rank.accuracy < rank.high
        assert rank.behind == pytest.approx(ranks[0].accuracy - rank.accuracy)
    assert ranks[0].behind == ranks[0].behind_low == ranks[0].behind_high == 0
    assert ranks[2].behind_low < ranks[2].behind < ranks[2].behind_high


def test_equal_lenses_are_in_one_group():
    """In at least 17 of 20 draws, twenty equally good lenses are in one group: 5 % are split wrongly."""
    split = [
        max(rank.group for rank in lens_ranks.rank_lenses(predictions(200, seed, *20 * [0.8]))) > 1
        for seed in range(20)
    ]
    assert sum(split) <= 3


def test_a_much_better_lens_is_alone_among_a_hundred():
    """Also if it classifies every photograph correctly, and the others none."""
    ranks = lens_ranks.rank_lenses(predictions(100, 0, 0.99, *99 * [0.2]))
    assert [rank.group for rank in ranks].count(1) == 1
    assert [rank.group for rank in lens_ranks.rank_lenses(predictions(50, 0, 1.0, 0.0))] == [1, 2]


def test_few_photographs_do_not_make_a_lens_perfect():
    """Ten of ten right: the accuracy is above 69 %, by the binomial distribution; the difference is as uncertain."""
    ranks = lens_ranks.rank_lenses(predictions(10, 0, 1.0, 1.0))
    assert [rank.low for rank in ranks] == pytest.approx([69.15] * 2, abs=0.01) and ranks[0].high == 100
    assert ranks[1].behind_high == pytest.approx(30.85, abs=0.01) == -ranks[1].behind_low
    (sentence,) = lens_ranks.sentences(ranks[:1], {})
    assert sentence == "a: 100.0 %, without another lens to compare with."


def test_photographs_that_all_agree_are_few():
    """In each of 8 photographs the second lens misses one field of 9: the difference may be up to 37 points off."""
    first = pandas.DataFrame(1, index=pandas.MultiIndex.from_product([range(8), ["a"]]), columns=[*"abcdefghi"])
    first.index.names = ["image", "label"]
    ranks = lens_ranks.rank_lenses({"a": first, "b": first.assign(i=0)})
    assert [rank.group for rank in ranks] == [1, 1]
    assert (ranks[1].behind_low, ranks[1].behind_high) == pytest.approx((11.11 - 36.94, 11.11 + 36.94), abs=0.01)
    ranks = lens_ranks.rank_lenses({"a": first.iloc[:3], "b": 0 * first.iloc[:3]})
    assert ranks[1].behind_high == 100 and ranks[1].behind_low == pytest.approx(29.24, abs=0.01)
    many = pandas.concat([first.rename(index=lambda k, c=copy: 8 * c + k, level=0) for copy in range(9)])
    assert [rank.group for rank in lens_ranks.rank_lenses({"a": many, "b": many.assign(i=0)})] == [1, 2]


def test_differences_are_of_the_same_photographs():
    """A lens that fails in a few photographs more is behind, however different the photographs are."""
    correct = predictions(300, 0, 0.5)
    worse = correct["a"].copy()
    worse.iloc[(worse.sum(axis=1) == 2).to_numpy().nonzero()[0][:12]] = 0
    ranks = lens_ranks.rank_lenses({**correct, "b": worse})
    assert [rank.group for rank in ranks] == [1, 2]
    assert ranks[1].behind_high - ranks[1].behind_low < 0.7 * (ranks[1].high - ranks[1].low)


def rank(lens: str, group: int, accuracy: float, low: float, high: float) -> Rank:
    return Rank(lens, group, accuracy, 0, 0, 0, low, high, ())


def test_the_columns_of_axis_and_corner_are_those_of_the_nine_fields():
    """The accuracy is that of the 16 fields between them."""
    first = Rank("a", 1, 60, 0, 0, 0, 50, 70, (40.0, 80.0, 60.0))
    at_nine = pandas.DataFrame([[1] * 8 + [0], [1] * 4 + [0] * 5])
    row = lens_ranks.row(first, "A", at_nine, 2.0, 60.0, 3.0)
    assert (row["accuracy_axis"], row["accuracy_corner"]) == (100.0, 0.0)
    assert row["accuracy_at_nine"] == pytest.approx(100 * 12 / 18) and row["accuracy"] == 60


def test_the_answer_in_words():
    ranks = [rank("a", 1, 90, 0, 0), rank("b", 1, 89.5, -0.2, 1.2), rank("c", 2, 85, 4, 7)]
    assert lens_ranks.sentences(ranks, {"a": "A", "b": "B"}) == [
        "A and B cannot be distinguished by these photographs: they agree within 1.2 points.",
        "c: 4.0 to 7.0 points behind the first.",
    ]
    assert lens_ranks.sentences([ranks[0], ranks[2]], {})[0] == "a is the best."


def test_what_the_sieve_may_have_missed():
    """A lens with a lower MTF was better by 5 points; the measured lens with the lowest MTF is 20 behind, then 3."""
    mtf = {"a": 0.9, "b": 0.8, "c": 0.5, "left": 0.4, "out": 0.3}
    ranks = [rank("b", 1, 90, 0, 0), rank("a", 1, 85, 0, 0), rank("c", 2, 70, 0, 0)]
    sentence = sieve(ranks, mtf, ["left", "out"])
    assert "Not measured: 2 lenses with a mean MTF of at most 0.40" in sentence and "by at most 5.0 points" in sentence
    assert "20.0 points behind the first" in sentence and "would be a surprise" in sentence
    close = [rank("b", 1, 90, 0, 0), rank("a", 1, 85, 0, 0), rank("c", 2, 87, 0, 0)]
    assert "cannot be excluded" in sieve(close, mtf, ["left", "out"])
    assert sieve(ranks, mtf, []) is None
    assert "all have one accuracy" in sieve([rank(name, 1, 90, 0, 0) for name in "abc"], mtf, ["out"])
