"""Several processes that train one network together, each on its share of every batch, as `torchrun` starts them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
from timm.layers import convert_sync_batchnorm
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from tasklens.study import StudyError


@dataclass(frozen=True)
class Team:
    """Which of how many processes this one is; the first also writes."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        return self.rank == 0

    def share(self, batch: int) -> slice:
        """Which of the `batch` pictures of a step are this process'.

        Raises:
            StudyError: the shares would differ in size, and the mean of their gradients would not be that of the batch.
        """
        if batch % self.size:
            raise StudyError(f"fine_tuning.batch: {batch} is no multiple of the {self.size} processes of a classifier")
        return slice(self.rank, None, self.size)

    def together(self, network: nn.Module) -> nn.Module:
        """The network, so that a backward pass leaves the mean of all processes' gradients in its parameters.

        Batch norms take the statistics of all shares on GPUs, and of their own on CPUs, for which torch has no other.
        """
        if self.size == 1:
            return network
        if torch.cuda.is_initialized():
            network = convert_sync_batchnorm(network)  # torch's own loses the activation in some of timm's batch norms
        return DistributedDataParallel(network)


ALONE = Team()


@contextmanager
def joined(device: torch.device) -> Iterator[Team]:
    """The team that `torchrun` has started, or this process alone."""
    if "WORLD_SIZE" not in os.environ:
        yield ALONE
        return
    waiting = timedelta(days=1)  # for the first process, which measures before the others train
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=waiting)
    try:
        yield Team(torch.distributed.get_rank(), torch.distributed.get_world_size())
    finally:
        torch.distributed.destroy_process_group()
