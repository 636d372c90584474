"""Networks by name: a timm model, or a user's function `package.module:function`."""

from typing import Any

import timm
from torch import nn

from tasklens.runtime.errors import InputError
from tasklens.study import user_code


def create(name: str, outputs: int, arguments: dict[str, Any], pretrained: bool = False) -> nn.Module:
    """Create a network with `outputs` outputs.

    Args:
        name: name in timm, or a function that takes `num_classes` and the arguments, and returns a module for images
            (B, 3, H, W) in [0, 1].

    Raises:
        InputError: there is no such function, or it does not return a module.
    """
    if not user_code.is_users(name):
        return timm.create_model(name, pretrained=pretrained, num_classes=outputs, **arguments)
    network = user_code.load(name)(num_classes=outputs, **arguments)
    if not isinstance(network, nn.Module):
        raise InputError(f"{name}: expected a torch.nn.Module, got {type(network).__name__}")
    return network
