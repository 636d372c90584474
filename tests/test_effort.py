"""Effort of designs: steps, evaluations and time, of each design and of its candidate lenses."""

import math
from pathlib import Path

import pandas
import pytest
from studies import tiny_study

from tasklens.study import effort
from tasklens.study.loading import parse
from tasklens.study.report import effort_table as report

DESCENT = {"steps": 5, "pixels": [4, 1]}
DESIGNS = {
    "squares": {"method": "least_squares", "evaluations": 700},
    "spots": {"descents": [{"optimizer": "adamw", "criterion": "spot", "steps": 30}]},
    "error": {"start": ["squares"], "descents": [DESCENT | {"criterion": "image_error"}]},
    "task": {
        "start": ["squares", "error"],
        "descents": [
            DESCENT | {"steps": 10, "lenses": 3},
            DESCENT,
            DESCENT | {"steps": 2},
            {"optimizer": "adamw", "steps": 4, "network_learning_rate": 1e-5},
        ],
    },
}


@pytest.fixture
def efforts() -> effort.Efforts:
    study = tiny_study() | {"designs": DESIGNS, "seeds": [0, 3], "ablations": {}}
    return effort.effort(parse(study))


def write_benchmark(folder: Path, lens: str, seed: int, seconds: int) -> None:
    path = folder / f"{lens}-seed{seed}.tsv"
    path.write_text(f"s\th:m:s\tmax_rss\tcpu_time\n{seconds}\t0:16:39\t-\t999\n")


def collect(efforts: effort.Efforts, folder: Path) -> pandas.DataFrame:
    files = [folder / f"{lens}-seed{seed}.tsv" for lens, seed in efforts.lens_keys]
    return report.collect(efforts, files).set_index("design")


def test_a_design_counts_the_lenses_it_was_chosen_from_each_once(efforts, tmp_path):
    """Steps of every descent of every lens, and evaluations; `squares` counts once, though two designs name it.

    Times are medians over the seeds.
    """
    for seed in (0, 3):
        for lens, minutes in (("squares", 2), ("spots", 1), ("error", 3), ("task", 5)):
            write_benchmark(tmp_path, f"singlet-{lens}", seed, 60 * (minutes + seed))
    rows = collect(efforts, tmp_path)
    assert rows["evaluations"].to_dict() == {"squares": 700, "spots": 30, "error": 5, "task": 3 * 10 + 5 + 2 + 4}
    assert rows["evaluations_in_all"].to_dict() == {"squares": 700, "spots": 30, "error": 705, "task": 746}
    assert rows["wall_minutes"].to_dict() == {"squares": 3.5, "spots": 2.5, "error": 4.5, "task": 6.5}
    assert rows["wall_minutes_in_all"].to_dict() == {"squares": 3.5, "spots": 2.5, "error": 8, "task": 14.5}


def test_a_time_that_was_not_measured_is_a_gap(efforts, tmp_path):
    """A gap, not a zero: for a job run by hand, or killed while its benchmark was written."""
    for seed in (0, 3):
        (tmp_path / f"singlet-squares-seed{seed}.tsv").write_text("s\th:m:s\tmax_rss\n")
        for lens in ("spots", "error", "task"):
            write_benchmark(tmp_path, f"singlet-{lens}", seed, 60)
    rows = collect(efforts, tmp_path)
    assert math.isnan(rows.loc["squares", "wall_minutes"]) and math.isnan(rows.loc["task", "wall_minutes_in_all"])
    assert rows.loc["spots", "wall_minutes_in_all"] == 1.0
