"""What `verify` finds in a study of which every file is known: nothing, or exactly what was broken."""

from pathlib import Path

import pandas
import pytest
import yaml
from examples import tiny_study
from tasklens.pipeline.layout import SHARP, Layout, restored

from tasklens.pipeline import jobs
from tasklens.report import tables, verification
from tasklens.study.study import parse

FIELDS, IMAGES = 9, 40
LENS = "singlet-imaging1"


@pytest.fixture
def study():
    tiny = tiny_study()
    return parse(tiny | {"designs": {"imaging1": tiny["designs"]["imaging1"], "tasklens": tiny["designs"]["tasklens"]}})


@pytest.fixture
def layout(tmp_path, study):
    """Lenses inside all limits, and classifiers that recognise 3 of 4 images at every field, each time again."""
    layout = Layout(str(tmp_path))
    for lens, classifier in jobs.verify(study).measured:
        right = [int(k % 4 > 0) for k in range(IMAGES)]
        fields = {f"field{k}": right for k in range(1 if lens == SHARP else FIELDS)}
        frame = pandas.DataFrame({"image": range(IMAGES), "label": "cat"} | fields)
        for path in (layout.predictions(lens, 0, classifier), layout.reproduced(lens, 0, classifier)):
            write(path, frame.to_csv(index=False))
        rows = [("accuracy", k, 75.0) for k in range(len(fields))] + [("chance", "", 10.0), ("parameters_m", "", 0.5)]
        rows += [("psnr_db", k, 20.0) for k in range(len(fields))]
        frame = pandas.DataFrame(rows, columns=["metric", "field", "value"])
        write(layout.metrics(lens, 0, classifier), frame.to_csv(index=False))
    for lens in study.lenses:
        write(layout.lens(lens, 0), yaml.safe_dump(lens_content(study.spec.efl_mm)))
    for job in jobs.verify(study).tables:
        tables.make(job, layout, "tiny", partial=False)
    return layout


def lens_content(efl_mm, **margins) -> dict:
    figures = {"rms_centroid_um": [9.0], "radius_50_um": [3.0], "energy_in_window": [0.9], "efl_mm": efl_mm}
    margins = {"max_slope": 0.1, "min_air_gap": 0.0, "efl_tolerance": 0.02} | margins
    worst = min(margins, key=margins.get)
    return {"figures": figures, "margins": margins, "worst_margin": {"limit": worst, "value": margins[worst]}}


def write(path: str, text: str) -> None:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def failures(study, layout) -> list[str]:
    return [str(failure) for failure in verification.verify(jobs.verify(study), layout).failures]


def test_a_study_that_keeps_its_word(study, layout):
    """Two lenses; sharp images and both lenses with two classifiers, and both restored."""
    found = verification.verify(jobs.verify(study), layout)
    assert not found.failures and not found.unconstrained
    assert (found.lenses, found.measurements) == (2, 8)
    assert verification.summary(found) == "Checked 2 lenses and 8 measurements: 0 failures."


@pytest.mark.parametrize(
    "margin, kept",
    [(0.0, True), (-5e-7, True), (-2e-6, False), (-0.1, False), (float("nan"), False), (float("-inf"), False)],
)
def test_a_broken_limit_is_named(study, layout, margin, kept):
    """A margin below zero, beyond rounding, or one that is no number; every broken limit of every lens."""
    content = lens_content(study.spec.efl_mm, max_slope=margin, max_track=-0.5)
    write(layout.lens(LENS, 0), yaml.safe_dump(content))
    found = failures(study, layout)
    assert f"{LENS} seed 0: max_track: margin -0.5" in found
    assert len(found) == (1 if kept else 2)
    assert kept or any(text.startswith(f"{LENS} seed 0: max_slope: margin {margin:.4g}") for text in found)


@pytest.mark.parametrize("part, kept", [(1.019, True), (0.981, True), (1.021, False), (0.979, False), (-1, False)])
def test_the_focal_length_is_kept_to_2_percent(study, layout, part, kept):
    content = lens_content(part * study.spec.efl_mm)
    write(layout.lens(LENS, 0), yaml.safe_dump(content))
    found = failures(study, layout)
    assert (not found) if kept else len(found) == 1 and found[0].startswith(f"{LENS} seed 0: efl_tolerance: margin -")


def test_a_lens_that_promised_nothing_is_reported_only(study, layout):
    write(layout.lens(LENS, 0), yaml.safe_dump(lens_content(9.0, max_slope=-0.1)))
    job = jobs.verify(study)
    assert job.constrained == tuple(lens for lens in job.lenses if "from_flat" not in lens)
    found = verification.verify(job.model_copy(update={"promising": ("singlet-tasklens",)}), layout)
    assert not found.failures
    assert [failure.limit for failure in found.unconstrained] == ["max_slope", "efl_tolerance"]
    assert "not promised: singlet-imaging1 seed 0: max_slope: margin -0.1" in verification.summary(found)


def test_a_lens_whose_design_diverged_is_named(study, layout):
    content = lens_content(study.spec.efl_mm) | {"origin": {"diverged": "step 3: field 2"}}
    write(layout.lens(LENS, 0), yaml.safe_dump(content))
    assert failures(study, layout) == [f"{LENS} seed 0: diverged: step 3: field 2"]


def edited(path, change):
    """Change a CSV file in place; `change` may return another frame."""
    frame = pandas.read_csv(path, keep_default_na=False)
    other = change(frame)
    (frame if other is None else other).to_csv(path, index=False)


def test_captures_that_are_recognised_otherwise(study, layout):
    """One capture of 360 is more than one in a thousand: in the images, and in the means of metrics and tables."""

    def lose_one(frame):
        frame.loc[1, "field3"] = 0

    edited(layout.reproduced(LENS, 0, restored("small")), lose_one)
    assert failures(study, layout) == [
        f"{LENS} seed 0: small-restored: stored images: 0.0028 of the captures differ",
        f"{LENS} seed 0: small-restored: metrics: 0.0028 of the captures differ",
        f"{LENS} seed 0: small-restored: table4: 75.00 % in the table, 74.72 % from the weights",
    ]


def test_a_swap_that_the_mean_does_not_show(study, layout):
    def swap(frame):
        frame.loc[[0, 1], "field3"] = [1, 0]

    edited(layout.predictions(LENS, 0, "other"), swap)
    assert failures(study, layout) == [f"{LENS} seed 0: other: stored images: 0.0056 of the captures differ"]


def test_an_edited_metrics_file(study, layout):
    """Also where the mean over fields stays, and where a field is missing."""

    def shift(frame):
        frame["value"] = frame["value"].astype(float)
        frame.loc[[0, 1], "value"] = [80.0, 70.0]

    edited(layout.metrics(LENS, 0, "small"), shift)
    assert failures(study, layout) == [f"{LENS} seed 0: small: metrics: 0.0111 of the captures differ"]
    edited(layout.metrics(LENS, 0, "small"), lambda frame: frame.iloc[1:])
    assert failures(study, layout) == [f"{LENS} seed 0: small: metrics: nan of the captures differ"]


def test_an_edited_table(study, layout):
    """The lens, and the row of sharp images."""

    def better(frame):
        frame["accuracy"] += 1.0

    edited(layout.table("table1", "csv"), better)
    expected = "small: table1: 76.00 % in the table, 75.00 % from the weights"
    assert failures(study, layout) == [f"{lens} seed 0: {expected}" for lens in (SHARP, LENS, "singlet-tasklens")]


def test_other_images_do_not_reproduce(study, layout):
    edited(layout.predictions(LENS, 0, "small"), lambda frame: frame.iloc[:-1])
    assert failures(study, layout) == [f"{LENS} seed 0: small: stored images: 1.0000 of the captures differ"]


def test_a_missing_reproduction_is_named(study, layout):
    Path(layout.reproduced(LENS, 0, "small")).unlink()
    with pytest.raises(FileNotFoundError, match=r"verification/singlet-imaging1/seed0/small-images.csv"):
        verification.verify(jobs.verify(study), layout)
