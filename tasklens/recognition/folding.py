"""Batch norms with stored statistics folded into the convolutions before them: the same function, fewer operations."""

from collections import Counter
from typing import Any

import torch
from timm.layers import BatchNormAct2d, Conv2dSame
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

_NORMS = (nn.BatchNorm2d, BatchNormAct2d)
_CONVOLUTIONS = (nn.Conv2d, Conv2dSame)  # others may change their weights when they are called


def fold_batch_norms(network: nn.Module, images: Tensor) -> None:
    """Fold batch norms into convolutions, in place, where nothing but the batch norm reads the convolution's output.

    W' = s W,  b' = s (b - mean) + shift,  s = scale / sqrt(variance + eps)

    A network whose answer is no tensor is left as it is.

    Args:
        network: network in `eval()` without parameter gradients.
        images: (B, 3, H, W) images for one pass, which shows what is read by what; their content does not matter.
    """
    names = {module: name for name, module in network.named_modules()}
    if not any(type(module) in _NORMS for module in names):
        return
    for convolution, norm in _pairs(network, images):
        network.set_submodule(names[convolution], fuse_conv_bn_eval(convolution, norm).requires_grad_(False))
        rest = (norm.get_submodule(name) for name in ("drop", "act") if isinstance(norm, BatchNormAct2d))
        network.set_submodule(names[norm], nn.Sequential(*rest))


def _pairs(network: nn.Module, images: Tensor) -> list[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Return the convolutions that a batch norm follows, each with its batch norm."""
    made: dict[Any, nn.Conv2d] = {}  # convolutions by the node of their output in autograd's graph
    found: list[tuple[Any, nn.Conv2d, nn.BatchNorm2d]] = []
    calls: Counter[nn.Module] = Counter()

    def after(module: nn.Conv2d, given: Any, output: Tensor) -> None:
        calls[module] += 1
        made[output.grad_fn] = module

    def before(module: nn.BatchNorm2d, given: tuple[Tensor]) -> None:
        calls[module] += 1
        if given[0].grad_fn in made:
            found.append((given[0].grad_fn, made[given[0].grad_fn], module))

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
    if not isinstance(answer, Tensor):
        return []
    readers = _readers(answer.grad_fn)
    places = Counter(module for _, module in network.named_modules(remove_duplicate=False))  # by which it may be called
    once = {module for module, count in calls.items() if count == places[module] == 1}
    return [(a, b) for node, a, b in found if readers[node] == 1 and {a, b} <= once]


def _readers(last: Any) -> Counter[Any]:
    """Count the operations that read each node of autograd's graph."""
    readers: Counter[Any] = Counter()
    seen, waiting = {last}, [last]
    while waiting:
        for node, _ in waiting.pop().next_functions:
            if node is not None:
                readers[node] += 1
                if node not in seen:
                    seen.add(node)
                    waiting.append(node)
    return readers
