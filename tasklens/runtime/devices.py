"""Devices of jobs: a GPU that no other job of this user on this machine uses, or the CPU."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock
from torch import Tensor

from tasklens.runtime.errors import InputError
from tasklens.runtime.locks import acquire, wait_until

CPU = torch.device("cpu")
_locked: dict[str, FileLock] = {}  # by GPU; a lock is released when its process ends


def claim() -> torch.device:
    """Claim a GPU for this process, and wait until one is free; without GPUs, return the CPU.

    Repeated calls return the same GPU. Parallel jobs of Snakemake are distributed over the visible GPUs, and wait if
    there are more jobs than GPUs.
    """
    (device,) = claim_several(1)
    if device != CPU:
        torch.cuda.set_device(device)
    return device


def claim_several(number: int) -> list[torch.device]:
    """Claim several GPUs, for a process group; without GPUs, return the CPU as often.

    Raises:
        InputError: fewer GPUs are visible.
    """
    count = torch.cuda.device_count()
    if count == 0:
        return number * [CPU]
    if number > count:
        raise InputError(f"{number} processes need one GPU each, but {count} are visible; lower `processes`")
    if number > 1:  # two groups that claim GPUs at the same time could deadlock
        wait_until(lambda: _lock("several"), "another process group that is claiming GPUs")
    gpus: list[torch.device] = []

    def claimed() -> bool:
        gpus.clear()
        for index in range(count):
            if len(gpus) < number and _lock(str(torch.cuda.get_device_properties(index).uuid)):
                gpus.append(torch.device("cuda", index))
        return len(gpus) == number

    wait_until(claimed, f"{number} of {count} GPUs, held by your other jobs")
    if number > 1:
        _locked.pop("several").release()
    return gpus


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a CPU tensor to `device`, asynchronously to a GPU."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


@contextmanager
def single_thread() -> Iterator[None]:
    """Make torch use one thread: sums over several threads differ in the last digit, and then images by a level."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
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
