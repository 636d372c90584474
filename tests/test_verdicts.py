"""Verdicts on claims follow from the predictions that a study measured."""

import math

import numpy
import pandas
import pytest
import yaml
from rules import finish
from studies import measurement, measurements_of
from study_results import DOUBLET, FIELDS, IMAGES, study_of, write_results

from tasklens.runtime.files import FileError
from tasklens.settings.names import SHARP
from tasklens.show.bootstrap import holm
from tasklens.study import claims
from tasklens.study.claims import FEWER_ELEMENTS, OVER_END_TO_END, OVER_IMAGE_QUALITY, OVER_IMAGING1, OVER_LEAST_SQUARES
from tasklens.study.loading import dump, parse
from tasklens.study.report import answers_file, verdicts
from tasklens.study.report.answers_file import PackedMeasurements
from tasklens.study.report.verdicts import FAILS, HOLDS, UNDECIDED

pytestmark = pytest.mark.usefixtures("here")


def planted_answers(contents, accuracy, minival=None, inside=0.9) -> PackedMeasurements:
    """Answers of which a fraction accuracy(lens, classifier, seed) is correct; it may differ between images.

    One random number per image and field, shared by all lenses, decides: a capture that is correct through a lens is
    also correct through a better one.
    """
    luck = numpy.random.default_rng(0).random((IMAGES, FIELDS))
    index = pandas.MultiIndex.from_product([range(IMAGES), ["cat"]], names=["image", "label"])
    answers, accuracies = {}, {}
    for key in contents.measured_keys:
        right = luck[:, : 1 if key.lens == SHARP else FIELDS] < accuracy(*key)
        answers[key] = pandas.DataFrame(right.astype(int), index)
        accuracies[key] = {"minival_accuracy": 100 * (minival or accuracy)(*key), "chance": 10.0}
    energy = dict.fromkeys(contents.lens_keys, inside)
    return PackedMeasurements({}, {}, answers=answers, accuracies=accuracies, energy=energy)


def verdicts_of(study, accuracy, **others) -> pandas.DataFrame:
    contents = claims.claims(study)
    rows = verdicts.collect(contents, planted_answers(contents, accuracy, **others))
    return rows.set_index(["table", "claim", "lens", "classifier"])


def collect(study) -> pandas.DataFrame:
    """The verdicts from the files of their job."""
    return verdicts.collect(claims.claims(study), measurements_of(study.name, claims.claims(study)))


def by_design(**accuracies):
    return lambda lens, name, seed: accuracies.get(lens.partition("-")[2] or lens, 0.5)


@pytest.mark.parametrize(
    "low, high, p, seeds, margin, expected, reason",  # the difference is in the middle of its interval
    [
        (0.1, 2, 0.01, 5, 0, HOLDS, "above zero"),
        (0.1, 2, 0.06, 5, 0, UNDECIDED, "at most 2.0 points either way"),  # not after the correction
        (-2, -0.1, 0.01, 5, 0, FAILS, "below zero"),
        (-0.4, 0.6, 0.7, 5, 0, UNDECIDED, "at most 0.6 points either way"),
        (-0.8, 0.6, 0.01, 5, 1, HOLDS, "above -1 points"),
        (-3, -1.2, 0.01, 5, 1, FAILS, "below -1 points"),
        (5, 6, 0.001, 4, 0, "suggests +5.5 points (5.0 to 6.0 over images and 4 seeds)", "fewer than five seeds"),
        (-6, -5, 0.001, 1, 0, "suggests -5.5 points (-6.0 to -5.0 over images, one seed)", "fewer than five seeds"),
        (-0.1, 0.62, 1.0, 5, 0, UNDECIDED, "at most 0.7 points either way"),  # rounded up
    ],
)
def test_rule(low, high, p, seeds, margin, expected, reason):
    assert verdicts.verdict((low + high) / 2, low, high, p, seeds, margin) == (expected, reason)


def test_the_same_claim_of_a_table_is_one_family():
    """P-values of two numbers of elements equal the uncorrected ones of single studies, corrected by Holm's method."""
    accuracy = by_design(tasklens=0.525, imaging1=0.52, imaging2=0.49, image_error=0.51)
    kinds = {"doublet": DOUBLET, "other": DOUBLET}
    alone = {name: verdicts_of(study_of(5, **{name: plastics}), accuracy)["p_holm"] for name, plastics in kinds.items()}
    both = verdicts_of(study_of(5, **kinds), accuracy)["p_holm"]
    for claim in (OVER_IMAGING1, OVER_LEAST_SQUARES, OVER_IMAGE_QUALITY):
        keys = [("table1", claim, f"{name}-tasklens", "small") for name in kinds]
        p_values = [alone[name][key] for name, key in zip(kinds, keys, strict=True)]
        assert both[keys].tolist() == pytest.approx(holm(p_values))
        assert 0 < min(p_values) < 0.5


def test_five_seeds_decide():
    """Clearly better, clearly worse, and equal, with seeds that vary together."""

    by_lens = by_design(tasklens=0.7, imaging1=0.5, imaging2=0.8, end_to_end_from_imaging=0.7)

    def accuracy(lens, name, seed):
        return by_lens(lens, name, seed) + 0.01 * seed

    frame = verdicts_of(study_of(5, doublet=DOUBLET), accuracy)
    better = frame.loc["table1", OVER_IMAGING1, "doublet-tasklens", "small"]
    assert better["verdict"] == HOLDS and better["difference"] == pytest.approx(20, abs=2)
    assert better["low"] < better["difference"] < better["high"] and better["seeds"] == 5
    worse = frame.loc["table4", OVER_LEAST_SQUARES, "doublet-tasklens", "small-restored"]
    assert worse["verdict"] == FAILS and worse["baseline"] == "doublet-imaging2"
    same = frame.loc["table3", OVER_END_TO_END, "doublet-tasklens", "small"]
    assert same["verdict"] == HOLDS and same["difference"] == same["low"] == same["high"] == 0  # at least as good


def test_one_lost_seed_moves_the_mean_and_not_the_median():
    """The number of seeds above zero shows it too; a claim with a margin counts seeds above minus the margin."""

    def accuracy(lens, name, seed):
        lost = lens == "doublet-imaging1" and seed == 3
        return 0.1 if lost else by_design(tasklens=0.6, imaging1=0.5)(lens, name, seed)

    frame = verdicts_of(study_of(5, doublet=DOUBLET), accuracy)
    row = frame.loc["table1", OVER_IMAGING1, "doublet-tasklens", "small"]
    assert row["difference"] == pytest.approx(18, abs=1.5) and row["median"] == pytest.approx(10, abs=1.5)
    assert row["above"] == 5
    same = frame.loc["table3", OVER_END_TO_END, "doublet-tasklens", "small"]
    assert same["median"] > 0 and same["above"] == 5


def test_the_baseline_is_chosen_on_the_minival():
    """imaging2 is the best by test and the worst by minival: the baseline is imaging3; each classifier has its own."""

    def minival(lens, name, seed):
        return by_design(imaging3=0.6, imaging2=0.9 if name == "other" else 0.1)(lens, name, seed)

    frame = verdicts_of(study_of(1), by_design(tasklens=0.6, imaging2=0.8), minival=minival)
    assert frame.loc["table1", OVER_LEAST_SQUARES, "doublet-tasklens", "small"]["baseline"] == "doublet-imaging3"
    assert frame.loc["table1", FEWER_ELEMENTS, "doublet-tasklens", "small"]["baseline"] == "triplet-imaging3"
    assert frame.loc["table2", OVER_LEAST_SQUARES, "doublet-tasklens", "other"]["baseline"] == "doublet-imaging2"


def test_each_seed_chooses_its_baseline():
    """Seed 1 has a bad imaging2, so its baseline is the other lens."""

    def accuracy(lens, name, seed):
        squares = 0.1 if seed == 1 else 0.6
        return by_design(tasklens=0.7, imaging2=squares, imaging3=0.5, image_error=0.2)(lens, name, seed)

    frame = verdicts_of(study_of(5, doublet=DOUBLET), accuracy)
    row = frame.loc["table1", OVER_LEAST_SQUARES, "doublet-tasklens", "small"]
    assert row["baseline"] == "doublet-imaging2 (4), doublet-imaging3 (1)"
    assert row["difference"] == pytest.approx((4 * 10 + 20) / 5, abs=3)


@pytest.mark.parametrize(
    "accuracy, inside, expected, difference",
    [(0.2, 0.9, HOLDS, 35), (0.8, 0.9, FAILS, -25), (0.8, 0.3, HOLDS, 20), (0.3, 0.3, HOLDS, 25)],
)
def test_convergence_is_judged_by_the_rule_of_table_3(accuracy, inside, expected, difference):
    """Sharp images 100 %, chance 10 %: half-way is 55 %. The light misses its half by 50 % minus the light inside."""
    accuracies = by_design(sharp=1.0, end_to_end_from_flat=accuracy)
    row = verdicts_of(study_of(5, doublet=DOUBLET), accuracies, inside=inside)
    row = row.loc["table3", claims.FLAT_FAILS, "doublet-end_to_end_from_flat", "small"]
    assert row["verdict"] == expected and row["baseline"] == ""
    assert row["difference"] == pytest.approx(difference, abs=3)


def test_interval_is_of_images_not_of_captures():
    """If all captures of an image agree, the error is that of 200 images, whatever the number of captures."""
    right = {
        lens: numpy.random.default_rng(k).random((IMAGES, 1)) < 0.6 for k, lens in enumerate(("tasklens", "imaging1"))
    }
    rows = verdicts_of(study_of(1, doublet=DOUBLET), by_design(**right), minival=by_design())
    row = rows.loc["table1", OVER_IMAGING1, "doublet-tasklens", "small"]
    difference = 100 * (1.0 * right["tasklens"] - right["imaging1"])
    assert row["difference"] == pytest.approx(difference.mean())
    width = 2 * 1.96 * difference.std() / math.sqrt(IMAGES)
    assert row["high"] - row["low"] == pytest.approx(width, rel=0.05)


def test_other_images_are_refused():
    study = study_of(1, doublet=DOUBLET)
    write_results(study, by_design())
    path = measurement(study.name, "doublet-imaging1", "small", kind="-predictions")
    pandas.read_csv(path).iloc[::-1].to_csv(path, index=False)
    with pytest.raises(FileError, match=r"doublet-imaging1.*test images differ"):
        collect(study)


def test_files_of_the_verdicts_agree():
    """CSV and Markdown have the verdicts of the measurements."""
    study = study_of(1, doublet=DOUBLET)
    write_results(study, by_design(tasklens=0.6))
    paths = finish("verdicts_table", study)
    rows = pandas.read_csv(paths.csv)
    body = [line for line in paths.md.read_text().splitlines() if line.startswith("|")][2:]
    assert len(rows) == len(claims.claims(study).claims)
    for row, line in zip(rows.itertuples(), body, strict=True):
        assert f"{row.difference:+.1f}" in line and row.lens in line and row.claim in line
    expected = verdicts_of(study, by_design(tasklens=0.6)).reset_index()
    assert rows["difference"].tolist() == pytest.approx(expected["difference"].tolist())


def with_fields(study, lens, name, right, seed: int = 0) -> None:
    """Add columns of answers at a set of fields to the predictions of a lens, correct for a fraction of the images."""
    path = measurement(study.name, lens, "small", seed, "-predictions")
    columns = {f"{name}{k}": (numpy.arange(IMAGES) < right * IMAGES).astype(int) for k in range(9)}
    pandas.read_csv(path).assign(**columns).to_csv(path, index=False)


def test_differences_at_the_nine_fields_stand_beside_those_of_the_grading(tmp_path):
    """If all lenses were measured there; also from a file of answers. A claim about failure has none."""
    study = parse(yaml.safe_load(dump(study_of(1, doublet=DOUBLET))) | {"tables": ["table1", "table3"]})
    write_results(study, by_design(tasklens=0.6, imaging1=0.5))
    own = claims.claims(study)
    lenses = sorted({key.lens for key in own.measured_keys} - {"sharp"})
    for lens in lenses[:-1]:
        with_fields(study, lens, "nine", 0.8 if lens == "doublet-tasklens" else 0.5)
    assert list(collect(study)) == verdicts.COLUMNS
    with_fields(study, lenses[-1], "nine", 0.8)
    assert lenses[-1] == "doublet-tasklens"
    rows = collect(study)
    assert list(rows) == [*verdicts.COLUMNS, *verdicts.AT_NINE]
    row = rows.set_index("claim").loc[OVER_IMAGING1]
    assert row["difference"] == pytest.approx(10, abs=3) and row["difference_at_nine"] == pytest.approx(30)
    assert row["low_at_nine"] < 30 < row["high_at_nine"]
    assert rows.set_index("claim").loc[claims.FLAT_FAILS, verdicts.AT_NINE].isna().all()
    answers_file.write(tmp_path / "verdicts.npz", own, measurements_of(study.name, own))
    pandas.testing.assert_frame_equal(verdicts.collect(*answers_file.read(tmp_path / "verdicts.npz")), rows)
    assert "at nine fields" in finish("verdicts_table", study).md.read_text()


@pytest.mark.parametrize("fields", ["design", "nine"])
def test_a_lens_fitted_to_the_fields_of_its_design_is_named(fields):
    """If it was measured there, and is better there than between them."""
    study = study_of(1, doublet=DOUBLET)
    write_results(study, by_design(tasklens=0.6, imaging1=0.6))
    for lens, right in (("doublet-tasklens", 0.9), ("doublet-imaging1", 0.5)):
        with_fields(study, lens, fields, right)
        path = measurement(study.name, lens, "small")
        path.write_text(path.read_text() + "".join(f"accuracy_at_design_fields,{k},90\n" for k in range(9)))
    text = finish("verdicts_table", study).md.read_text()
    words = "doublet-tasklens, small, seed 0 is fitted to the fields of its design: 90.0 % there, "
    assert words in text and text.count("is fitted to") == 1
