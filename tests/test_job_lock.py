"""A job runs in one process at a time; a waiting process names the other, and uses its results."""

import json
import multiprocessing
import time

import pytest

from tasklens.runtime import locks

CONTEXT = multiprocessing.get_context("fork")


def job(folder, key: str, begun, go_on) -> None:
    with locks.alone(folder / "job.lock", key, [folder / "output"]) as work:
        begun.set()
        go_on.wait()
        if work:
            (folder / "output").write_text(key)


@pytest.fixture
def other(tmp_path, monkeypatch):
    """A function that starts a job in another process; it ends, or is killed, once this process waits."""

    def start(key: str, kill: bool = False):
        begun, go_on = CONTEXT.Event(), CONTEXT.Event()
        process = CONTEXT.Process(target=job, args=(tmp_path, key, begun, go_on), daemon=True)
        process.start()
        begun.wait()

        def sleep(_: float) -> None:
            process.kill() if kill else go_on.set()
            process.join()

        monkeypatch.setattr(locks.time, "sleep", sleep)
        return process

    return start


def work_of(folder, key: str) -> bool:
    with locks.alone(folder / "job.lock", key, [folder / "output"]) as work:
        return work


def test_a_job_alone_works_every_time(tmp_path):
    (tmp_path / "output").write_text("old")
    assert work_of(tmp_path, "a") and work_of(tmp_path, "a")
    assert json.loads((tmp_path / "job.json").read_text())["done"] == "a"


def test_what_the_other_has_made_is_taken(tmp_path, other, capsys):
    process = other("a")
    assert not work_of(tmp_path, "a") and (tmp_path / "output").read_text() == "a"
    assert f"waiting for process {process.pid} on " in capsys.readouterr().err


@pytest.mark.parametrize("key, kill", [("b", False), ("a", True)])
def test_the_work_is_done_again_where_the_other_computes_something_else_or_is_killed(tmp_path, other, key, kill):
    (tmp_path / "output").write_text("old")
    other("a", kill)
    assert work_of(tmp_path, key)


def test_a_line_at_once_and_every_half_minute(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(locks.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(locks.time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    locks.wait_until(lambda: now[0] >= 165, "a GPU")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"waiting for a GPU, {seconds} s" for seconds in (0, 30, 60)]
    locks.wait_until(lambda: True, "nothing")
    assert not capsys.readouterr().err and time.monotonic() == now[0]


def test_a_file_system_without_locks_is_reported(tmp_path, monkeypatch, capsys):
    """The job still runs, without a lock."""

    def refuse(self, **_):
        raise NotImplementedError("flock")

    monkeypatch.setattr(locks.FileLock, "acquire", refuse)
    assert work_of(tmp_path, "a")
    assert "job.lock: this file system has no file locks" in capsys.readouterr().err
