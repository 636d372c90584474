"""Forecasts: durations, limits and memory of jobs, from constructed benchmark files."""

import csv

import pytest
import yaml
from examples import write
from rules import rule_names

from tasklens.study.run import forecast
from tasklens.study.run.forecast import Durations, Measured

HEADER = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time"  # as Snakemake writes it


def benchmark(folder, job: str, *rows: tuple[object, object]) -> None:
    """Write the file of a job, with seconds and memory [MB] of each measurement."""
    lines = [f"{s}\t0:00:00\t{mb}\t9999.0\t100.0\t100.0\t0.0\t0.0\t99.0\t1.0" for s, mb in rows]
    write(folder / "benchmarks" / f"{job}.tsv", "\n".join([HEADER, *lines]) + "\n")


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A folder of results without benchmarks; elsewhere, the study `mine` was measured."""
    write(
        tmp_path / "durations.csv",
        "study,rule,seconds,longest_s,memory_mb\n"
        "mine,design,100,900,1000\nmine,psf,4,5,200\nmine,tail,6,8,300\ntheirs,figure,1000,1000,1000\n",
    )
    monkeypatch.setattr(forecast, "MEASURED", tmp_path / "durations.csv")
    return tmp_path / "results"


def durations(results, study: str = "mine") -> Durations:
    return Durations(study, str(results))


def test_benchmarks_are_of_stages(results):
    """A stage collects all its jobs, in its folder or a single file; the last row of a file counts."""
    benchmark(results, "design/singlet-imaging1-seed0", (10, 500))
    benchmark(results, "design/singlet-imaging2-seed0", (99, 9999), (30.5, 700.5))
    benchmark(results, "fine_tune/singlet-imaging1-small-seed0", (7, 800))
    benchmark(results, "images", (0.01, "-"))  # too short for a measurement
    write(results / "benchmarks" / "verdicts.tsv", HEADER + "\n")  # killed before it was measured
    assert durations(results).here == {
        "design": Measured(20.25, 30.5, 700.5),
        "fine_tune": Measured(7, 7, 800),
        "images": Measured(0.01, 0.01, 0),
    }


def test_without_benchmarks_it_is_as_long_as_elsewhere(results):
    """For the study measured there; other studies and other stages are unknown."""
    estimates = durations(results)
    assert estimates.here == {} and estimates.scale == 1
    assert (estimates.seconds("design"), estimates.seconds("psf"), estimates.seconds("figure")) == (100, 4, None)
    assert estimates.elsewhere["tail"] == Measured(6, 8, 300)
    assert durations(results, "yours").elsewhere == {} and durations(results, "yours").seconds("design") is None


def test_what_ran_here_comes_first_and_scales_the_rest(results):
    """Stages that are known in both places ran (150 + 6) / (100 + 4) = 1.5 times as long here."""
    benchmark(results, "design/a", (120, 500))
    benchmark(results, "design/b", (180, 500))
    benchmark(results, "psf/a", (6, 100))
    benchmark(results, "restore/a", (40, 100))  # unknown elsewhere
    estimates = durations(results)
    assert estimates.scale == pytest.approx(1.5)
    assert estimates.seconds("design") == 150 and estimates.seconds("restore") == 40
    assert estimates.seconds("tail") == pytest.approx(9)
    assert estimates.seconds("figure") is None


def test_a_job_may_take_four_times_the_longest_of_its_stage(results):
    """Measured here or elsewhere, at least ten minutes; a day if there is no measurement."""
    assert durations(results).limit_minutes("design") == 4 * 900 / 60
    assert durations(results).limit_minutes("psf") == 10
    assert durations(results).limit_minutes("figure") == 24 * 60
    benchmark(results, "design/a", (300, 500))
    assert durations(results).limit_minutes("design") == 3 * 60  # this machine takes three times as long
    benchmark(results, "design/a", (1200, 500))
    benchmark(results, "design/b", (1, 500))
    assert durations(results).limit_minutes("design") == pytest.approx(4 * 900 / 60 * 600.5 / 100, abs=0.5)
    for job in "ab":
        benchmark(results, f"design/{job}", (50, 500))  # a machine that is fast here may be slow at other jobs
    assert durations(results).limit_minutes("design") == 60


def test_a_job_is_given_half_as_much_memory_again_as_the_largest_of_its_stage(results):
    """Measured here or elsewhere; at least 1 GB; 4 GB if it is unknown or the job was too short for a measurement."""
    assert durations(results).memory_mb("design") == 1500
    assert durations(results).memory_mb("figure") == 4000
    benchmark(results, "design/a", (1, 1200))
    benchmark(results, "design/b", (1, 1400))
    benchmark(results, "images", (0.01, "-"))
    benchmark(results, "tail/a", (0.01, "-"))
    assert durations(results).memory_mb("design") == 2100
    assert durations(results).memory_mb("images") == 4000
    assert durations(results).memory_mb("tail") == 1000


def test_the_forecast_adds_up(results):
    """12 designs and 12 PSFs of 1200 + 48 s on two cores are 10.4 minutes; unknown stages are named."""
    stages = 12 * ["design", "psf"]
    assert durations(results).forecast(stages, 2) == "Study mine: 24 jobs, about 10 min on 2 cores."
    assert durations(results).forecast(stages, 1) == "Study mine: 24 jobs, about 21 min on 1 core."
    estimate = durations(results).forecast([*stages, "figure", "figure", "restore"], 2)
    assert estimate.startswith("Study mine: 27 jobs, about 10 min on 2 cores; the duration of")
    assert estimate.endswith("figure, restore is not known yet.")
    no_estimate = durations(results).forecast(["figure"], 2)
    assert "Study mine: 1 job; the duration of figure is not known" in no_estimate and " min " not in no_estimate
    assert durations(results).forecast([], 2).startswith("Study mine: 0 jobs")


def test_the_durations_that_we_ship_are_of_our_studies():
    """Each once, of an existing stage, with the longest at least the mean; gaps if not measured."""
    with open(forecast.MEASURED, newline="") as file:
        rows = list(csv.DictReader(file))
    files = forecast.MEASURED.parent.glob("*.yaml")  # also studies that extend another
    studies = {name for path in files if (name := yaml.safe_load(path.read_text()).get("name"))}
    studies.add("ranking")  # what `tasklens rank` runs
    assert len({(row["study"], row["rule"]) for row in rows}) == len(rows) > 0
    for row in rows:
        assert row["study"] in studies and row["rule"] in rule_names()
        assert 0 < float(row["seconds"]) <= float(row["longest_s"] or "inf") and float(row["memory_mb"] or 1) > 0
