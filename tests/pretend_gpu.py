"""A GPU that is not there: tensors say that they are on it, compute on the CPU, and refuse to mix with others.

CUDA refuses an operation on tensors of two devices, except with numbers (tensors of no dimension) of the CPU, and
indices. So does this, which finds in code for GPUs what no run on a CPU finds: a tensor that was not sent, a result
that was not fetched, a generator of the other device. Half precision is left out.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

GPU = torch.device("cuda", 0)
CPU = torch.device("cpu")
aten = torch.ops.aten
# What copies between devices, and what takes indices or values of the CPU.
COPIES = {aten._to_copy.default, aten.copy_.default, aten._local_scalar_dense.default}
LAZY = {aten._conj.default: aten.conj_physical.default, aten._neg_view.default: aten.neg.default}  # but for marks
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default}


class OnGpu(torch.Tensor):
    """A tensor on the GPU, with its values on the CPU in `values`."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> "OnGpu":
        # For torch on no device, since it would ask a driver about a GPU's.
        found = torch.Tensor._make_wrapper_subclass(
            cls, values.shape, values.stride(), values.storage_offset(), dtype=values.dtype, device="meta"
        )
        found.values = values
        return found

    @property
    def device(self) -> torch.device:
        return GPU

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        raise AssertionError("a tensor of the GPU outlives it")

    def __getitem__(self, index):
        parts = index if isinstance(index, tuple) else (index,)  # a list would become a tensor of no values
        return super().__getitem__(tuple(torch.tensor(each) if isinstance(each, list) else each for each in parts))

    def tolist(self) -> object:  # torch's own is not for other classes
        return self.values.tolist()

    def pin_memory(self, *_):
        raise RuntimeError("cannot pin 'torch.cuda.FloatTensor', only dense CPU tensors can be pinned")


class PretendGpu(TorchDispatchMode):
    """While it is active, tensors can be on the GPU; `operations` counts those that ran there."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        flat, tree = tree_flatten((args, kwargs or {}))
        tensors = [each for each in flat if isinstance(each, torch.Tensor)]
        here = [each for each in tensors if isinstance(each, OnGpu)]
        there = [each for each in tensors if not isinstance(each, OnGpu) and each.dim() > 0]
        if here and there and function not in COPIES | INDEXED:
            shapes = ", ".join(str(tuple(each.shape)) for each in there)
            raise RuntimeError(f"{function}: expected all tensors on {GPU}, found {shapes} on the CPU")
        generators = [each for each in flat if isinstance(each, torch.Generator)]
        asked = (kwargs or {}).get("device")
        on_gpu = bool(here) if asked is None else torch.device(asked).type in (GPU.type, "meta")
        if function is aten.copy_.default:
            on_gpu = isinstance(args[0], OnGpu)
        if on_gpu and any(each.device == CPU for each in generators):
            raise RuntimeError(f"{function}: expected a generator of {GPU}, found one of the CPU")
        values = [each.values if isinstance(each, OnGpu) else each for each in flat]
        values = [CPU if isinstance(each, torch.device) else each for each in values]
        args, kwargs = tree_unflatten(values, tree)
        found = LAZY.get(function, function)(*args, **kwargs)
        self.operations += on_gpu
        known = {id(each.values): each for each in here}
        return tree_map(lambda each: self._placed(each, on_gpu, known), found)

    @staticmethod
    def _placed(value, on_gpu: bool, known: dict[int, OnGpu]):
        if not isinstance(value, torch.Tensor) or not on_gpu:
            return value
        found = known.get(id(value))  # what an operation changed in place stays itself
        return OnGpu(value) if found is None else found


@contextmanager
def pretend_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendGpu]:
    """Pretend that there is a GPU while the block runs."""
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self, *_: self)
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(
        True
    )  # else a network that is moved keeps its parameters
    try:
        with PretendGpu() as gpu:
            yield gpu
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)
