"""Which device a job computes on: a GPU that no other job of ours has on this machine, or the CPU."""

import fcntl
import tempfile
import time
from pathlib import Path

import torch
from torch import Tensor

CPU = torch.device("cpu")
_locked: dict[str, object] = {}  # by GPU, open files: a lock ends with its process, however that ends


def claim() -> torch.device:
    """A GPU for this process alone, once one is free, and the same when asked again; the CPU where there is none.

    Jobs that Snakemake runs side by side spread over the visible GPUs, and wait where there are more jobs than those.
    """
    count = torch.cuda.device_count()
    if count == 0:
        return CPU
    while True:
        for index in range(count):
            if _lock(str(torch.cuda.get_device_properties(index).uuid)):
                torch.cuda.set_device(index)
                return torch.device("cuda", index)
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
