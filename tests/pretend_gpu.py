"""A GPU that is not there: tensors say that they are on it, compute on the CPU, and refuse to mix with others.

CUDA refuses an operation on tensors of two devices, except for scalars (tensors without dimensions) on the CPU, and
indices. This module refuses the same, and so finds errors that no run on a CPU finds: a tensor not moved to the GPU, a
result not copied back, a generator on the other device. It does not cover half precision.
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
# Operations that copy between devices, and operations that take indices or values of the CPU.
COPIES = {aten._to_copy.default, aten.copy_.default, aten._local_scalar_dense.default}
LAZY = {aten._conj.default: aten.conj_physical.default, aten._neg_view.default: aten.neg.default}  # but for marks
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default}


class OnGpu(torch.Tensor):
    """A tensor on the GPU, with its values on the CPU in `values`."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> "OnGpu":
        # On the meta device for torch, which would ask a driver about a tensor on a GPU.
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, values.shape, values.stride(), values.storage_offset(), dtype=values.dtype, device="meta"
        )
        tensor.values = values
        return tensor

    @property
    def device(self) -> torch.device:
        return GPU

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        raise AssertionError("a tensor of the GPU outlives it")

    def __getitem__(self, index):
        parts = index if isinstance(index, tuple) else (index,)  # a list would become a tensor of no values
        return super().__getitem__(tuple(torch.tensor(part) if isinstance(part, list) else part for part in parts))

    def tolist(self) -> object:  # torch's own method refuses other classes
        return self.values.tolist()

    def pin_memory(self, *_):
        raise RuntimeError("cannot pin 'torch.cuda.FloatTensor', only dense CPU tensors can be pinned")


class PretendGpu(TorchDispatchMode):
    """While this mode is active, tensors can be on the GPU; `operations` counts the operations that ran there."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        flat, tree = tree_flatten((args, kwargs or {}))
        tensors = [value for value in flat if isinstance(value, torch.Tensor)]
        gpu_tensors = [value for value in tensors if isinstance(value, OnGpu)]
        cpu_tensors = [value for value in tensors if not isinstance(value, OnGpu) and value.dim() > 0]
        if gpu_tensors and cpu_tensors and function not in COPIES | INDEXED:
            shapes = ", ".join(str(tuple(value.shape)) for value in cpu_tensors)
            raise RuntimeError(f"{function}: expected all tensors on {GPU}, found {shapes} on the CPU")
        generators = [value for value in flat if isinstance(value, torch.Generator)]
        target = (kwargs or {}).get("device")
        on_gpu = bool(gpu_tensors) if target is None else torch.device(target).type in (GPU.type, "meta")
        if function is aten.copy_.default:
            on_gpu = isinstance(args[0], OnGpu)
        if on_gpu and any(value.device == CPU for value in generators):
            raise RuntimeError(f"{function}: expected a generator of {GPU}, found one of the CPU")
        values = [value.values if isinstance(value, OnGpu) else value for value in flat]
        values = [CPU if isinstance(value, torch.device) else value for value in values]
        args, kwargs = tree_unflatten(values, tree)
        result = LAZY.get(function, function)(*args, **kwargs)
        self.operations += on_gpu
        wrappers = {id(value.values): value for value in gpu_tensors}
        return tree_map(lambda value: self._placed(value, on_gpu, wrappers), result)

    @staticmethod
    def _placed(value, on_gpu: bool, wrappers: dict[int, OnGpu]):
        if not isinstance(value, torch.Tensor) or not on_gpu:
            return value
        wrapper = wrappers.get(id(value))  # a tensor changed in place keeps its wrapper
        return OnGpu(value) if wrapper is None else wrapper


@contextmanager
def pretend_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendGpu]:
    """Pretend that there is a GPU while the block runs."""
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self, *_: self)
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(
        True
    )  # otherwise a moved network keeps its old parameters
    try:
        with PretendGpu() as gpu:
            yield gpu
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)
