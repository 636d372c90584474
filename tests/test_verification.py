"""`verify` on a study with known files: it finds nothing, or exactly the planted errors."""

import shutil
from pathlib import Path

import pandas
import pytest
import yaml
from examples import write
from rules import finish, outputs
from studies import changed, measurements_of, tiny_study, with_imported
from study_results import write_measurement

from tasklens.settings.names import SHARP
from tasklens.study import table_contents
from tasklens.study.loading import parse
from tasklens.study.report import verification

FIELDS, IMAGES = 9, 40
LENS = "singlet-imaging1"
FROZEN = tiny_study()["designs"]["tasklens"]["descents"][:-1]  # the last one trains the network


@pytest.fixture(scope="module")
def study():
    designs = {name: tiny_study()["designs"][name] for name in ("imaging1", "tasklens")}
    return parse(changed(tiny_study() | {"designs": designs}, "designs.tasklens.descents", FROZEN))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, study):
    """Lenses inside all limits, and classifiers that are right on 3 of 4 images at every field, each time."""
    folder = tmp_path_factory.mktemp("verification")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_files(study)
    return folder


@pytest.fixture(autouse=True)
def results(here, folder):
    """A copy of the files for each test."""
    shutil.copytree(folder, here, dirs_exist_ok=True)


def write_files(study) -> None:
    for lens, name in table_contents.verification(study).measured:
        fields = 1 if lens == SHARP else FIELDS
        values = {"accuracy": [75.0] * fields, "minival_accuracy": [75.0] * fields, "psnr_db": [20.0] * fields}
        values |= {"chance": 10.0, "parameters_m": 0.5}
        right = [[int(k % 4 > 0)] * fields for k in range(IMAGES)]
        losses = [[0.1 * (k % 3)] * fields for k in range(IMAGES)]
        write_measurement(study.name, lens, name, 0, values, predictions=right, frozen=losses)
        write(second_predictions(study, lens, name), predictions(study, lens, name).read_text())
    for lens in study.lenses:
        write(lens_file(study, lens), yaml.safe_dump(lens_content(study.spec.efl_mm)))
    for name in study.tables:
        if table_contents.table(study, name).lenses:
            finish("table", study, table=name)


def metrics(study, lens, name) -> Path:
    return outputs("fine_tune", study, lens=lens, measured_name=name, seed=0).metrics


def predictions(study, lens, name) -> Path:
    return outputs("fine_tune", study, lens=lens, measured_name=name, seed=0).predictions


def second_predictions(study, lens, name) -> Path:
    return outputs("reproduce", study, lens=lens, measured_name=name, seed=0).predictions


def lens_file(study, lens) -> Path:
    return outputs("design", study, lens=lens, seed=0).lens


def lens_content(efl_mm, **margins) -> dict:
    means = {"rms_spot_um": 9.0, "core_radius_um": 3.0, "energy_in_window": 0.9}
    margins = {"max_slope": 0.1, "min_air_gap": 0.0, "efl_tolerance": 0.02} | margins
    worst = min(margins, key=margins.get)
    computed = {"figures": {"efl_mm": efl_mm}, "means": means, "margins": margins}
    return computed | {"worst_margin": {"limit": worst, "value": margins[worst]}}


def verify(study, **changes) -> tuple[list[str], list[str]]:
    """Failures, and limits of unconstrained lenses, in the files of the job; `changes` are changes of its settings."""
    contents = table_contents.verification(study).model_copy(update=changes)
    every = table_contents.verification(study)
    anew = {key: outputs("reproduce", study, **wildcards_of(key)).predictions for key in every.measured_keys}
    csv_paths = {entry.name: outputs("table", study, table=entry.name).csv for entry in every.tables}
    return verification.verify(contents, measurements_of(study.name, every), anew, csv_paths)


def wildcards_of(key) -> dict:
    return dict(zip(("lens", "measured_name", "seed"), key, strict=True))


def failures(study) -> list[str]:
    return verify(study)[0]


def test_a_study_without_errors_passes(study):
    """Two lenses; sharp images and both lenses with two classifiers, and both restored."""
    assert verify(study) == ([], [])


@pytest.mark.parametrize("margin, kept", [(-5e-7, True), (-2e-6, False), (float("nan"), False), (float("-inf"), False)])
def test_a_broken_limit_is_named(study, margin, kept):
    """A margin below zero, beyond rounding, or one that is no number; every broken limit of every lens."""
    content = lens_content(study.spec.efl_mm, max_slope=margin, max_track=-0.5)
    write(lens_file(study, LENS), yaml.safe_dump(content))
    messages = failures(study)
    assert f"{LENS} seed 0: max_track: margin -0.5" in messages
    assert len(messages) == (1 if kept else 2)
    assert kept or any(text.startswith(f"{LENS} seed 0: max_slope: margin {margin:.4g}") for text in messages)


@pytest.mark.parametrize("part", [0.979, 0.981, 1.019, 1.021, -1])
def test_the_focal_length_is_kept_to_2_percent(study, part):
    write(lens_file(study, LENS), yaml.safe_dump(lens_content(part * study.spec.efl_mm)))
    messages = [message.partition(" -")[0] for message in failures(study)]
    assert messages == ([] if abs(part - 1) < 0.02 else [f"{LENS} seed 0: efl_tolerance: margin"])


def test_a_lens_that_is_not_constrained_is_reported_only(study):
    write(lens_file(study, LENS), yaml.safe_dump(lens_content(9.0, max_slope=-0.1)))
    settings = table_contents.verification(study)
    assert settings.constrained == settings.lenses == tuple(study.lenses)
    failures, unconstrained = verify(study, constrained=("singlet-tasklens",))
    assert not failures
    slope, efl = unconstrained
    assert slope == f"{LENS} seed 0: max_slope: margin -0.1" and efl.startswith(f"{LENS} seed 0: efl_tolerance: margin")


def test_which_lenses_are_constrained_and_which_must_be_local_optima():
    """All but end-to-end from flat plates and the imported; those of them designed by captures or PSFs."""
    settings = table_contents.verification(parse(with_imported()))
    assert {*settings.lenses} - {*settings.constrained} == {"singlet-end_to_end_from_flat", "quadruplet-phone"}
    supervised = ("singlet-tasklens", "singlet-image_error", "singlet-end_to_end_from_imaging")
    assert settings.with_optimum == supervised


def test_a_lens_whose_design_diverged_is_named(study):
    content = lens_content(study.spec.efl_mm) | {"origin": {"diverged": "step 3: field 2"}}
    write(lens_file(study, LENS), yaml.safe_dump(content))
    assert failures(study) == [f"{LENS} seed 0: diverged: step 3: field 2"]


def optimum(gain: float, error: float = 0.001) -> dict:
    """A test of a local optimum, as in a lens file."""
    return {"local_optimum": {"step_um": 0.3, "gain": gain, "error": error, "along": "gradient", "images": 192}}


def test_a_supervised_lens_that_is_no_local_optimum_is_named(study):
    """A step lowers the loss by over two standard errors and 0.002; lenses designed by spots are not tested."""
    for lens in study.lenses:
        write(lens_file(study, lens), yaml.safe_dump(lens_content(study.spec.efl_mm) | optimum(0.0039)))
    assert failures(study) == []
    for lens in study.lenses:
        write(lens_file(study, lens), yaml.safe_dump(lens_content(study.spec.efl_mm) | optimum(0.0041)))
    (message,) = failures(study)
    assert message == (
        "singlet-tasklens seed 0: not converged: a step within the limits lowers the loss: "
        "+0.0041 +- 0.0010, 0.3 um, gradient"
    )
    write(lens_file(study, "singlet-tasklens"), yaml.safe_dump(lens_content(study.spec.efl_mm) | optimum(-0.5)))
    assert failures(study) == []


def cells(rows, column, values):
    """A change of a table: other values of some cells."""

    def change(frame):
        frame.loc[rows, column] = values
        return frame

    return change


@pytest.mark.parametrize(
    "path, name, change, expected",
    [
        # One capture of 360 is more than one in a thousand: in the images, and in the means of metrics and tables.
        (second_predictions, "small-restored", cells(1, "field3", 0),
         ["stored predictions: 0.0028 of the captures differ", "metrics: 0.0028 of the captures differ",
          "table4: 75.00 % in the table, 74.72 % from the weights"]),
        (predictions, "other", cells([0, 1], "field3", [1, 0]),  # the mean does not show it
         ["stored predictions: 0.0056 of the captures differ"]),
        (predictions, "small", lambda frame: frame.iloc[:-1], ["stored predictions: 1.0000 of the captures differ"]),
        (metrics, "small", cells([0, 1], "value", [80.0, 70.0]), ["metrics: 0.0111 of the captures differ"]),
        (metrics, "small", lambda frame: frame.iloc[1:], ["metrics: nan of the captures differ"]),
    ],
)  # fmt: skip
def test_an_edited_file_of_a_measurement(study, path, name, change, expected):
    file = path(study, LENS, name)
    change(pandas.read_csv(file)).to_csv(file, index=False)
    assert failures(study) == [f"{LENS} seed 0: {name}: {message}" for message in expected]


def test_an_edited_table(study):
    """The rows of the lenses and the row of sharp images."""
    csv = outputs("table", study, table="table1").csv
    frame = pandas.read_csv(csv, keep_default_na=False)
    frame.assign(accuracy=frame["accuracy"] + 1.0).to_csv(csv, index=False)
    expected = "small: table1: 76.00 % in the table, 75.00 % from the weights"
    assert failures(study) == [f"{lens} seed 0: {expected}" for lens in (SHARP, LENS, "singlet-tasklens")]


def test_the_job_says_what_it_found_and_fails_by_its_status(study, capsys):
    """All on standard output, below the verdicts, and the number of failures in the log; if none, the status is 0."""
    write(outputs("verdicts_table", study).md, "the verdicts\n")
    finish("verify", study)
    assert capsys.readouterr().out == "the verdicts\n\nChecked 2 lenses and 8 measurements: 0 failures.\n"
    write(lens_file(study, LENS), yaml.safe_dump(lens_content(study.spec.efl_mm, max_slope=-0.1)))
    with pytest.raises(SystemExit, match="1"):
        finish("verify", study)
    printed = capsys.readouterr()
    assert "failed: singlet-imaging1 seed 0: max_slope: margin -0.1" in printed.out
    assert printed.err.endswith("failures, printed above: 1\n")
