"""Batch norms folded into convolutions: the same function of the images, in fewer operations."""

import copy

import pytest
import timm
import torch
from torch import nn

from tasklens.recognition.folding import fold_batch_norms


def normalised(model: nn.Module) -> nn.Module:
    """The network in float64 with nontrivial statistics, as after training."""
    torch.manual_seed(0)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            if module.affine:
                nn.init.uniform_(module.weight, 0.5, 1.5)
                nn.init.normal_(module.bias, std=0.1)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    return model.double().eval().requires_grad_(False)


def batch_norms(model: nn.Module) -> int:
    return sum(isinstance(module, nn.BatchNorm2d) for module in model.modules())


def folded_copy(model: nn.Module, images: torch.Tensor) -> nn.Module:
    """The folded network, whose logits and their gradient at the images are those of the model."""
    folded = copy.deepcopy(model)
    fold_batch_norms(folded, images[:1].float())
    leaf = images.clone().requires_grad_()
    logits = [network(leaf) for network in (folded, model)]
    gradients = [torch.autograd.grad(values.square().sum(), leaf)[0] for values in logits]
    for value, expected in (logits, gradients):
        torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-12)
    return folded


@pytest.mark.parametrize(
    ("name", "arguments", "left"),
    [
        ("resnet18", {"layers": (1, 1, 1, 1), "channels": (8, 16, 32, 64)}, 0),
        ("mobilenetv2_050", {"pad_type": "same"}, 0),
        ("densenet121", {"growth_rate": 8, "block_config": (2, 2)}, None),
        ("swin_tiny_patch4_window7_224", {"img_size": 64, "window_size": 4, "embed_dim": 24, "depths": (2, 2)}, 0),
    ],
)
def test_networks_of_timm_compute_the_same(name, arguments, left):
    """Values and gradients; none is left if each follows a convolution, some are left if they precede convolutions."""
    model = normalised(timm.create_model(name, num_classes=5, **arguments))
    images = torch.rand(2, 3, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    remaining = batch_norms(folded_copy(model, images))
    assert remaining == left if left is not None else 0 < remaining < batch_norms(model)


class Awkward(nn.Module):
    """Not foldable: an output with two readers, a convolution called twice, an activation, a module with two names."""

    def __init__(self):
        super().__init__()
        self.conv1, self.conv2, self.conv3, self.conv5 = (nn.Conv2d(3, 3, 3, padding=1) for _ in range(4))
        self.norm1, self.norm2, self.norm3, self.norm5 = (nn.BatchNorm2d(3) for _ in range(4))
        self.other = self.norm5
        self.conv4, self.norm4 = nn.Conv2d(3, 3, 3, padding=1, bias=False), nn.BatchNorm2d(3, affine=False)

    def forward(self, images):
        features = self.conv1(images)
        images = features + self.norm1(features).relu()
        images = self.norm2(self.conv2(self.conv2(images)))
        images = self.norm3(self.conv3(images).relu_())
        images = self.other(self.conv5(images))
        return self.norm4(self.conv4(images)).mean((2, 3))


def test_only_what_nothing_else_reads_is_folded():
    model = normalised(Awkward())
    images = torch.rand(2, 3, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    folded = folded_copy(model, images)
    assert batch_norms(folded) == 4 and not isinstance(folded.norm4, nn.BatchNorm2d)
