"""Devices of jobs: a GPU that no other job of ours on this machine uses, or the CPU."""

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import torch
from filelock import FileLock, Timeout
from torch import Tensor

from tasklens.runtime.errors import InputError

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
    while wanted > 1 and not _lock("several"):  # two groups that claim GPUs at once could deadlock
        time.sleep(1.0)
    while True:
        found: list[torch.device] = []
        for index in range(count):
            if len(found) < wanted and _lock(str(torch.cuda.get_device_properties(index).uuid)):
                found.append(torch.device("cuda", index))
        if len(found) == wanted:
            if wanted > 1:
                _locked.pop("several").release()
            return found
        time.sleep(1.0)


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a CPU tensor to `device`, asynchronously to a GPU."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


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
    """Try to lock a name; return whether this process now holds the lock."""
    if name in _locked:
        return True
    lock = FileLock(Path(tempfile.gettempdir()) / f"tasklens-{name}.lock", mode=0o666)  # of all users of the machine
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    _locked[name] = lock
    return True
