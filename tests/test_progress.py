"""Progress lines: when they appear, what they forecast, and what is left of them."""

import time

import pytest

from tasklens.runtime.progress import Progress, progress_file, read_progress


@pytest.mark.parametrize("first", [1, 51])
def test_what_remains_is_forecast_from_the_steps_of_this_run(first, monkeypatch, capsys):
    """Two seconds a step after a first that compiles for a minute, also if a job resumes from a checkpoint."""
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    progress = Progress("design", 100, interval=15.0)
    for step in range(first, 101):
        clock[0] += 60.0 if step == first else 2.0
        progress(step, loss=0.5)
    lines = capsys.readouterr().err.splitlines()
    steps = [int(line.split("step ")[1].split("/")[0]) for line in lines]
    remaining = [float(line.split("remaining ")[1].split(" s")[0]) for line in lines[1:-1]]
    assert steps[0] == first and steps[-1] == 100 and steps[1] == first + 8  # 16 s later
    assert remaining == [2.0 * (100 - step) for step in steps[1:-1]]
    assert lines[0] == f"design  step {first}/100  loss 0.5"


def test_the_file_of_a_job_has_its_forecast(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with progress_file(tmp_path, "design/0"):
        progress = Progress("design", 10)
        for step, remaining in ((1, None), (2, 16.0), (3, 14.0)):
            clock[0] += 2.0
            progress(step)
            assert read_progress(tmp_path, "design/0").get("remaining_s") == remaining


def test_a_job_that_fails_leaves_no_progress(tmp_path, capsys):
    """Its log still has the progress lines."""
    with pytest.raises(ZeroDivisionError), progress_file(tmp_path, "design/0"):
        Progress("design", 2)(1, loss=0.5)
        raise ZeroDivisionError
    assert read_progress(tmp_path, "design/0") is None
    assert "design  step 1/2  loss 0.5" in capsys.readouterr().err
