"""Devices of jobs: a GPU that no other job of ours on this machine uses, or the CPU."""

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
    """Claim a GPU for this process, waiting until one is free; repeated calls return the same; without GPUs the CPU.

    Parallel jobs of Snakemake are distributed over the visible GPUs, and wait if there are more jobs than GPUs.
    """
    (device,) = claim_several(1)
    if device != CPU:
        torch.cuda.set_device(device)
    return device


def claim_several(wanted: int) -> list[torch.device]:
    """Claim `wanted` GPUs, for a process group; without GPUs the CPU.

    Raises:
        InputError: fewer GPUs are visible.
    """
    count = torch.cuda.device_count()
    if count == 0:
        return wanted * [CPU]
    if wanted > count:
        raise InputError(f"{wanted} processes need a GPU each; visible are {count}: lower `processes`")
    if wanted > 1:  # two groups that claim GPUs at once could deadlock
        wait_until(lambda: _lock("several"), "another process group, which claims GPUs")
    found: list[torch.device] = []

    def claimed() -> bool:
        found.clear()
        for index in range(count):
            if len(found) < wanted and _lock(str(torch.cuda.get_device_properties(index).uuid)):
                found.append(torch.device("cuda", index))
        return len(found) == wanted

    wait_until(claimed, f"{wanted} of {count} GPUs, which other jobs of yours hold")
    if wanted > 1:
        _locked.pop("several").release()
    return found


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a CPU tensor to `device`, asynchronously to a GPU."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


@contextmanager
def single_thread() -> Iterator[None]:
    """Let torch compute with one thread: sums of several differ in the last digit, and images then in a level."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def random_state() -> dict[str, Tensor]:
    """Return the states of torch's random numbers, on the CPU and on the GPU if one is used."""
    state = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_initialized():
        state["gpu"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: Mapping[str, Tensor]) -> None:
    """Set the states of torch's random numbers to those that `random_state` returned."""
    torch.set_rng_state(state["cpu"])
    if "gpu" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["gpu"])


def half_precision(device: torch.device) -> torch.autocast:
    """Return the autocast context of networks: bfloat16 on a GPU, for its tensor cores, float32 on the CPU."""
    return torch.autocast("cuda", torch.bfloat16, enabled=device.type == "cuda")


def _lock(name: str) -> bool:
    """Try to lock a name; return whether this process now holds the lock.

    Locks are in the user's home, where nobody else can put a link, and which containers and jobs with a TMPDIR of their
    own have in common. Between users, whoever runs the jobs gives out the GPUs: Snakemake's resource `gpu`, a cluster.
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
