"""Process groups started by `torchrun`: they train one network, each process on its share of every batch."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from tasklens.runtime.devices import CPU, claim, claim_several
from tasklens.runtime.errors import InputError


@dataclass(frozen=True)
class ProcessGroup:
    """Rank of this process, number of processes, and device; the first process writes files."""

    rank: int = 0
    size: int = 1
    device: torch.device = CPU

    @property
    def is_first(self) -> bool:
        """True in the first process, which writes the files."""
        return self.rank == 0

    @property
    def share(self) -> slice:
        """Slice of the images of a step for this process; `processes` divides `fine_tuning.batch_size`."""
        return slice(self.rank, None, self.size)

    def wrap(self, network: nn.Module) -> nn.Module:
        """Wrap a network so that a backward pass averages the gradients of all processes.

        Batch norms use the statistics of all shares on GPUs, and of their own share on CPUs, where torch cannot
        synchronise them.
        """
        if self.size == 1:
            return network
        if self.device != CPU:
            from timm.layers import convert_sync_batchnorm

            network = convert_sync_batchnorm(network)  # torch's function drops activations of timm's batch norms
        return DistributedDataParallel(network)


SINGLE_PROCESS = ProcessGroup()


@contextmanager
def process_group() -> Iterator[ProcessGroup]:
    """Join the process group started by `torchrun`, each process with its own GPU; without it, yield a single process.

    Raises:
        InputError: the machine has GPUs, but fewer than the group has processes.
    """
    if "WORLD_SIZE" not in os.environ:
        yield ProcessGroup(device=claim())
        return
    count = torch.cuda.device_count()
    if 0 < count < int(os.environ["WORLD_SIZE"]):
        raise InputError(
            f"processes: a classifier's {os.environ['WORLD_SIZE']} processes need one GPU each, but this machine has "
            f"{count}"
        )
    timeout = timedelta(days=1)  # for GPUs, and for the first process, which measures before the others train
    backends = "cpu:gloo,cuda:nccl" if count else "gloo"
    torch.distributed.init_process_group(backends, timeout=timeout)
    try:
        rank, size = torch.distributed.get_rank(), torch.distributed.get_world_size()
        # The first process claims the GPUs of all processes: otherwise two groups could deadlock.
        devices = claim_several(size) if rank == 0 else size * [CPU]
        torch.distributed.broadcast_object_list(devices, device=CPU)
        if devices[rank] != CPU:
            torch.cuda.set_device(devices[rank])
        yield ProcessGroup(rank, size, devices[rank])
    finally:
        torch.distributed.destroy_process_group()
