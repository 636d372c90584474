"""Devices of jobs: a GPU that few or no other jobs of this user on this machine use, or the CPU."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import torch
from filelock import FileLock
from threadpoolctl import threadpool_limits
from torch import Tensor

from tasklens.runtime.errors import InputError
from tasklens.runtime.locks import acquire, wait_until

CPU = torch.device("cpu")
JOBS_PER_GPU = "TASKLENS_JOBS_PER_GPU"  # environment variable; 1 if it is not set
_locked: dict[str, FileLock] = {}  # by GPU and share; a lock is released when its process ends


def claim() -> torch.device:
    """Claim a GPU for this process, and wait until one is free; without GPUs, return the CPU.

    Repeated calls return the same GPU. Parallel jobs of Snakemake are distributed over the visible GPUs, and wait if
    each of these has `TASKLENS_JOBS_PER_GPU` jobs, by default one.

    Raises:
        InputError: the number of jobs per GPU is not a positive integer.
    """
    count = torch.cuda.device_count()
    if count == 0:
        return CPU
    value = os.environ.get(JOBS_PER_GPU, "1")
    if not (value.isdecimal() and int(value)):
        raise InputError(f"{JOBS_PER_GPU}={value}: expected a positive integer")
    names = [torch.cuda.get_device_properties(index).uuid for index in range(count)]
    shares = [(index, f"{names[index]}-{share}") for share, index in product(range(int(value)), range(count))]
    shares.sort(key=lambda entry: entry[1] not in _locked)  # that of this process first
    gpus: list[int] = []

    def claimed() -> bool:
        for index, share in shares:
            if _lock(share):
                gpus.append(index)
                return True
        return False

    wait_until(claimed, f"one of {count} GPUs, held by your other jobs")
    device = torch.device("cuda", gpus[0])
    torch.cuda.set_device(device)
    return device


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a tensor to `device`, asynchronously from the CPU to a GPU."""
    to_gpu = tensor.device.type == "cpu" and device.type == "cuda"
    return tensor.pin_memory().to(device, non_blocking=True) if to_gpu else tensor.to(device)


@contextmanager
def single_thread() -> Iterator[None]:
    """Make torch, numpy and scipy use one thread: sums over several threads differ in the last digit.

    Small matrices are not faster in several threads, and ten times slower if another process uses their cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(threads)


def random_state() -> dict[str, Tensor]:
    """Return the states of torch's random number generators: of the CPU, and of the GPU if one is used."""
    state = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_initialized():
        state["gpu"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: Mapping[str, Tensor]) -> None:
    """Set torch's random number generators to the states that `random_state` returned."""
    torch.set_rng_state(state["cpu"])
    if "gpu" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["gpu"])


def half_precision(device: torch.device) -> torch.autocast:
    """Return the autocast context of networks: bfloat16 on a GPU, for its tensor cores, float32 on the CPU."""
    return torch.autocast("cuda", torch.bfloat16, enabled=device.type == "cuda")


def _lock(name: str) -> bool:
    """Try to lock a name; return whether this process now holds the lock.

    Locks are in the user's home: nobody else can put a link there, and containers and jobs with their own TMPDIR share
    it. Between users, Snakemake's resource `gpu` or the cluster distributes the GPUs.
    """
    if name in _locked:
        return True
    folder = Path.home() / ".cache" / "tasklens" / "gpus"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    lock = FileLock(folder / f"{name}.lock")
    if not acquire(lock):
        return False
    _locked[name] = lock
    return True
