"""NAFNet, a network for image restoration without nonlinear activations (Chen et al. 2022, arXiv:2204.04676).

Parameters have the names of the original, so that published weights can be loaded.
"""

from pathlib import Path

import torch
from timm.layers import LayerNorm2d
from torch import Tensor, nn

from tasklens.runtime.devices import half_precision
from tasklens.runtime.files import damage_error, read_tensors
from tasklens.settings.network_settings import RestorationSettings


class SimpleGate(nn.Module):
    """Product of the two halves of the channels."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, 2 C, H, W) to (B, C, H, W)."""
        first, second = x.chunk(2, dim=1)
        return first * second


class NAFBlock(nn.Module):
    """Two residual branches, gated convolution with channel attention and gated mixing, weighted by beta and gamma."""

    def __init__(self, channels: int):
        super().__init__()
        c = channels
        self.norm1, self.norm2 = LayerNorm2d(c), LayerNorm2d(c)
        self.conv1 = nn.Conv2d(c, 2 * c, 1)
        self.conv2 = nn.Conv2d(2 * c, 2 * c, 3, padding=1, groups=2 * c)
        self.sca = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(c, c, 1))
        self.conv3 = nn.Conv2d(c, c, 1)
        self.conv4 = nn.Conv2d(c, 2 * c, 1)
        self.conv5 = nn.Conv2d(c, c, 1)
        self.sg = SimpleGate()
        self.beta = nn.Parameter(torch.zeros(1, c, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, c, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        y = self.sg(self.conv2(self.conv1(self.norm1(x))))
        x = x + self.beta * self.conv3(y * self.sca(y))
        return x + self.gamma * self.conv5(self.sg(self.conv4(self.norm2(x))))


class NAFNet(nn.Module):
    """A U-net of NAFBlocks that adds a correction to its input."""

    def __init__(self, settings: RestorationSettings):
        super().__init__()
        width, self.multiple = settings.width, settings.multiple
        self.intro = nn.Conv2d(3, width, 3, padding=1)
        self.encoders, self.downs = nn.ModuleList(), nn.ModuleList()
        c = width
        for blocks in settings.encoder:
            self.encoders.append(nn.Sequential(*(NAFBlock(c) for _ in range(blocks))))
            self.downs.append(nn.Conv2d(c, 2 * c, 2, stride=2))
            c *= 2
        self.middle_blks = nn.Sequential(*(NAFBlock(c) for _ in range(settings.middle)))
        self.ups, self.decoders = nn.ModuleList(), nn.ModuleList()
        for blocks in settings.decoder:
            self.ups.append(nn.Sequential(nn.Conv2d(c, 2 * c, 1, bias=False), nn.PixelShuffle(2)))
            c //= 2
            self.decoders.append(nn.Sequential(*(NAFBlock(c) for _ in range(blocks))))
        self.ending = nn.Conv2d(width, 3, 3, padding=1)
        self.to(memory_format=torch.channels_last)  # a third faster on a CPU

    def forward(self, captures: Tensor) -> Tensor:
        """Restore captures (B, 3, H, W); raises ValueError unless H and W are multiples of 2^levels."""
        if captures.shape[-2] % self.multiple or captures.shape[-1] % self.multiple:
            raise ValueError(
                f"captures of {captures.shape[-2]} x {captures.shape[-1]} pixels: expected multiples of {self.multiple}"
            )
        with half_precision(captures.device):
            return captures + self._correction(captures.contiguous(memory_format=torch.channels_last)).float()

    def _correction(self, x: Tensor) -> Tensor:
        x = self.intro(x)
        skips = []
        for blocks, down in zip(self.encoders, self.downs, strict=True):
            x = blocks(x)
            skips.append(x)
            x = down(x)
        x = self.middle_blks(x)
        for blocks, up, skip in zip(self.decoders, self.ups, reversed(skips), strict=True):
            x = blocks(up(x) + skip)
        return self.ending(x)


def load(settings: RestorationSettings, path: Path) -> NAFNet:
    """Read a trained network in `eval()`; raises FileError if the file does not have the weights of `settings`."""
    network = NAFNet(settings)
    try:
        network.load_state_dict(read_tensors(path)[0])
    except RuntimeError as error:  # its first line suffices: the others list tensors
        raise damage_error(path, f"not the weights of this network ({str(error).splitlines()[0]})") from None
    return network.eval().requires_grad_(False)
