"""Jobs spread over the GPUs of a machine, or run on the CPU if there is none."""

import multiprocessing
from types import SimpleNamespace

import pytest
import torch
from threadpoolctl import threadpool_info

from tasklens.runtime import devices, locks
from tasklens.runtime.errors import InputError

CONTEXT = multiprocessing.get_context("fork")


def pretend(monkeypatch, names: list[str]) -> None:
    """Pretend that there are as many GPUs as names."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(names))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: SimpleNamespace(uuid=names[index]))
    monkeypatch.setattr(torch.cuda, "set_device", lambda index: None)


def test_without_a_gpu_it_is_the_cpu(monkeypatch):
    pretend(monkeypatch, [])
    assert devices.claim() == torch.device("cpu")


def hold(name: str, ready, done) -> None:
    devices._locked.clear()  # locks that a forked process seems to hold are its parent's
    assert devices._lock(name)
    ready.set()
    done.wait()


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    """A function that starts another process to hold a share of a GPU, and returns the process."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(devices, "_locked", {})

    def held(name: str, share: int = 0) -> multiprocessing.Process:
        ready = CONTEXT.Event()
        process = CONTEXT.Process(target=hold, args=(f"{name}-{share}", ready, CONTEXT.Event()), daemon=True)
        process.start()
        ready.wait()
        return process

    return held


def test_a_gpu_has_one_job(monkeypatch, elsewhere):
    """A lock of another process is respected, and is free once that process ends, for any reason."""
    names = ["one", "other"]
    pretend(monkeypatch, names)
    other = elsewhere(names[0])
    assert devices.claim() == devices.claim() == torch.device("cuda", 1)
    waited = []
    monkeypatch.setattr(devices, "_locked", {}), pretend(monkeypatch, names[:1])
    monkeypatch.setattr(locks.time, "sleep", lambda seconds: (waited.append(seconds), other.kill(), other.join()))
    assert devices.claim() == torch.device("cuda", 0)
    assert len(waited) == 1


def test_several_jobs_share_a_gpu(monkeypatch, elsewhere):
    """Each GPU gets a job before any gets two; a process keeps its GPU if a share of another one becomes free."""
    monkeypatch.setenv(devices.JOBS_PER_GPU, "2")
    names = ["one", "other"]
    pretend(monkeypatch, names)
    first = elsewhere("one")
    assert devices.claim() == torch.device("cuda", 1)
    first.kill(), first.join()
    assert devices.claim() == torch.device("cuda", 1) and set(devices._locked) == {"other-0"}
    elsewhere("one"), elsewhere("one", 1)
    monkeypatch.setattr(devices, "_locked", {})  # as in a further process
    assert devices.claim() == torch.device("cuda", 1) and set(devices._locked) == {"other-1"}


@pytest.mark.parametrize("value", ["0", "", "two"])
def test_the_number_of_jobs_per_gpu_is_checked(monkeypatch, value):
    pretend(monkeypatch, ["one"])
    monkeypatch.setenv(devices.JOBS_PER_GPU, value)
    with pytest.raises(InputError, match=f"TASKLENS_JOBS_PER_GPU={value}: expected a positive integer"):
        devices.claim()


def test_locks_are_private_to_the_user(monkeypatch, tmp_path):
    """Locks are in the user's home, whatever TMPDIR is, even under an umask that shuts out the user's other jobs."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "mine"))
    monkeypatch.setattr(devices, "_locked", {})
    pretend(monkeypatch, ["one"])
    assert devices.claim() == torch.device("cuda", 0)
    (lock,) = (path for path in tmp_path.rglob("*") if path.is_file())
    assert lock.parent == tmp_path / "home/.cache/tasklens/gpus" and lock.parent.stat().st_mode & 0o077 == 0


def test_one_thread_for_small_matrices(two_threads):
    """Of torch, numpy and scipy, which have two before and after."""

    def threads() -> set[int]:
        pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
        return {torch.get_num_threads(), *(pool["num_threads"] for pool in pools)}

    with devices.single_thread():
        assert threads() == {1}
    assert threads() == {2}
