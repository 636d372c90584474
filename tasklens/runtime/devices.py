"""Which device a job computes on: a GPU that no other job of ours has on this machine, or the CPU."""

import fcntl
import tempfile
import time
from pathlib import Path
from typing import TextIO

import torch
from torch import Tensor

CPU = torch.device("cpu")
_locked: dict[str, TextIO] = {}  # by GPU, open files: a lock ends with its process, however that ends


def claim() -> torch.device:
    """Claim a GPU for this process, as soon as one is free; the same when asked again, the CPU where there is none.

    Jobs that Snakemake runs side by side spread over the visible GPUs, and wait where there are more jobs than those.
    """
    (device,) = claim_several(1)
    if device != CPU:
        torch.cuda.set_device(device)
    return device


def claim_several(wanted: int) -> list[torch.device]:
    """Claim `wanted` GPUs, of which the machine has that many, for this process group; the CPU where there is none."""
    count = torch.cuda.device_count()
    if count == 0:
        return wanted * [CPU]
    while wanted > 1 and not _lock("several"):  # two that collect at once could wait for each other without end
        time.sleep(1.0)
    while True:
        found: list[torch.device] = []
        for index in range(count):
            if len(found) < wanted and _lock(str(torch.cuda.get_device_properties(index).uuid)):
                found.append(torch.device("cuda", index))
        if len(found) == wanted:
            if wanted > 1:
                _locked.pop("several").close()
            return found
        time.sleep(1.0)


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the CPU on `device`; to a GPU it goes without waiting for what that still has to do."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def half_precision(device: torch.device) -> torch.autocast:
    """Where a network computes: in bfloat16 on a GPU, whose tensor cores want that, in float32 on the CPU."""
    return torch.autocast("cuda", torch.bfloat16, enabled=device.type == "cuda")


def _lock(name: str) -> bool:
    """Whether this process holds the lock of this name, from now on or already."""
    if name in _locked:
        return True
    path = Path(tempfile.gettempdir()) / f"tasklens-{name}.lock"
    if not path.exists():
        path.touch()
    file = path.open()  # for reading, which is enough for a lock: the file may be another user's
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return False
    _locked[name] = file
    return True
