"""Networks by name: a timm model, or a user's function `package.module:function`."""

import socket
import urllib.parse
import urllib.request
from typing import Any

import huggingface_hub
import timm
from torch import nn

from tasklens.runtime import user_code
from tasklens.runtime.errors import InputError

_REACH_S = 5.0  # timeout to reach the hub


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


def check_published(model: str) -> None:
    """Check that published weights are in the hub's cache, or that the hub is reachable.

    Without a connection, the hub's library retries for most of a minute, and its error does not name the network.

    Raises:
        InputError: neither is true; the message names the network.
    """
    config = timm.get_pretrained_cfg(model)
    if config is None or not config.hf_hub_id or urllib.request.getproxies():  # hosted elsewhere, or behind a proxy
        return
    files = ("model.safetensors", "pytorch_model.bin")
    if any(isinstance(huggingface_hub.try_to_load_from_cache(config.hf_hub_id, file), str) for file in files):
        return
    address = urllib.parse.urlsplit(huggingface_hub.constants.ENDPOINT)
    host, port = str(address.hostname), address.port or (80 if address.scheme == "http" else 443)
    try:
        if huggingface_hub.constants.HF_HUB_OFFLINE:
            raise OSError("HF_HUB_OFFLINE is set")
        socket.create_connection((host, port), timeout=_REACH_S).close()
    except OSError as error:
        raise InputError(
            f"{model}: its published weights are not in the cache, and {host} cannot be reached ({error}); connect to "
            "it, or name a file in `weights`"
        ) from error
