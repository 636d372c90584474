"""Folding of batch norms with stored statistics into the preceding convolutions: same function, fewer operations."""

from collections import Counter
from typing import Any

import torch
from timm.layers import BatchNormAct2d, Conv2dSame
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

_NORMS = (nn.BatchNorm2d, BatchNormAct2d)
_CONVOLUTIONS = (nn.Conv2d, Conv2dSame)  # subclasses may change their weights when called


def fold_batch_norms(network: nn.Module, images: Tensor) -> None:
    """Fold batch norms into convolutions in place, if only the batch norm reads the convolution's output.

    W' = s W,  b' = s (b - mean) + shift,  s = scale / sqrt(variance + eps)

    A network is unchanged if its output is not a tensor.

    Args:
        network: network in `eval()` without parameter gradients.
        images: (B, 3, H, W) images for one pass that traces the data flow; their content does not matter.
    """
    names = {module: name for name, module in network.named_modules()}
    if not any(type(module) in _NORMS for module in names):
        return
    for convolution, norm in _pairs(network, images):
        network.set_submodule(names[convolution], fuse_conv_bn_eval(convolution, norm).requires_grad_(False))
        rest = (norm.get_submodule(name) for name in ("drop", "act") if isinstance(norm, BatchNormAct2d))
        network.set_submodule(names[norm], nn.Sequential(*rest))


def _pairs(network: nn.Module, images: Tensor) -> list[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Return each convolution that a batch norm follows, with its batch norm."""
    producers: dict[Any, nn.Conv2d] = {}  # convolution by the autograd node of its output
    candidates: list[tuple[Any, nn.Conv2d, nn.BatchNorm2d]] = []
    calls: Counter[nn.Module] = Counter()

    def after(module: nn.Conv2d, inputs: Any, output: Tensor) -> None:
        calls[module] += 1
        producers[output.grad_fn] = module

    def before(module: nn.BatchNorm2d, inputs: tuple[Tensor]) -> None:
        calls[module] += 1
        if inputs[0].grad_fn in producers:
            candidates.append((inputs[0].grad_fn, producers[inputs[0].grad_fn], module))

    hooks = []
    for module in network.modules():
        if type(module) in _CONVOLUTIONS:
            hooks.append(module.register_forward_hook(after))
        elif type(module) in _NORMS:
            hooks.append(module.register_forward_pre_hook(before))
    with torch.enable_grad():
        answer = network(images.detach().to(next(network.parameters())).requires_grad_())
    for hook in hooks:
        hook.remove()
    if not isinstance(answer, Tensor) or answer.grad_fn is None:
        return []
    readers = _readers(answer.grad_fn)
    places = Counter(module for _, module in network.named_modules(remove_duplicate=False))  # names of each module
    single_use = {module for module, count in calls.items() if count == places[module] == 1}
    return [(a, b) for node, a, b in candidates if readers[node] == 1 and {a, b} <= single_use]


def _readers(last: Any) -> Counter[Any]:
    """Count the operations that read each node of autograd's graph."""
    readers: Counter[Any] = Counter()
    visited, queue = {last}, [last]
    while queue:
        for node, _ in queue.pop().next_functions:
            if node is not None:
                readers[node] += 1
                if node not in visited:
                    visited.add(node)
                    queue.append(node)
    return readers
