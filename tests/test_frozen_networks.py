"""A frozen copy of a network: the same answers in fewer operations, and gradients to images alone."""

import copy

import pytest
import timm
import torch
from examples import random_images, trained_network
from torch import nn

from tasklens.recognition import classifiers
from tasklens.runtime.errors import InputError


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
    return model.double()


def batch_norms(model: nn.Module) -> list[str]:
    """All names of batch norms, frozen or not."""
    modules = model.named_modules(remove_duplicate=False)
    return [name for name, module in modules if "BatchNorm" in type(module).__name__]


def frozen_copy(model: nn.Module, images: torch.Tensor) -> nn.Module:
    """The frozen network, whose logits and their gradient at the images are those of the model in `eval()`."""
    frozen = classifiers.frozen(model, images)
    assert model.training and all(parameter.requires_grad for parameter in model.parameters())
    assert not frozen.training and not any(parameter.requires_grad for parameter in frozen.parameters())
    model.eval().requires_grad_(False)
    leaf = images.clone().requires_grad_()
    logits = [network(leaf) for network in (frozen, model)]
    gradients = [torch.autograd.grad(values.square().sum(), leaf)[0] for values in logits]
    for value, expected in (logits, gradients):
        torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-12)
    return frozen


def saved_bytes(network: nn.Module, images: torch.Tensor) -> int:
    """Bytes of the tensors that the network saves for gradients at the images."""
    sizes: dict[int, int] = {}

    def keep(tensor):
        sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        logits = network(images.clone().requires_grad_())
    assert logits.requires_grad  # and with it the tensors are alive
    return sum(sizes.values())


@pytest.mark.parametrize("model, share", [("test_resnet", 0.7), ("test_vit", 1.0)])
def test_a_frozen_copy_remembers_less(model, share):
    """Convolutional networks save at most 0.7 of the bytes for gradients."""
    classifier = normalised(classifiers.Classifier(timm.create_model(model, num_classes=5)))
    size = classifier.network.pretrained_cfg["input_size"][-1]
    images = torch.rand(2, 3, size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert saved_bytes(frozen_copy(classifier, images), images) <= share * saved_bytes(classifier, images)


@pytest.mark.parametrize(
    ("name", "arguments", "left"),
    [
        ("resnet18", {"layers": (1, 1, 1, 1), "channels": (8, 16, 32, 64)}, 0),
        ("mobilenetv2_050", {"pad_type": "same"}, 0),
        ("densenet121", {"growth_rate": 8, "block_config": (2, 2)}, None),
        ("swin_tiny_patch4_window7_224", {"img_size": 64, "window_size": 4, "embed_dim": 24, "depths": (2, 2)}, 0),
    ],
)
def test_batch_norms_of_networks_of_timm_are_folded(name, arguments, left):
    """None is left if each follows a convolution, some are left if they precede convolutions."""
    model = normalised(timm.create_model(name, num_classes=5, **arguments))
    images = torch.rand(2, 3, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    remaining = len(batch_norms(frozen_copy(model, images)))
    assert remaining == left if left is not None else 0 < remaining < len(batch_norms(model))


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
    images = torch.rand(2, 3, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert batch_norms(frozen_copy(normalised(Awkward()), images)) == ["norm1", "norm2", "norm3", "norm5", "other"]


def test_batch_norms_of_a_frozen_network_by_the_batch():
    """Captures of half the contrast give the same logits; stored statistics stay, and no weight has a gradient."""
    classifier = trained_network(0)
    before = copy.deepcopy(classifier.state_dict())
    images, _ = random_images(12, 16, 3, seed=1).batch(torch.arange(12))
    frozen = classifiers.frozen(classifier, images, "batch")
    images.requires_grad_()
    whole, faint = frozen(images), frozen(0.5 * images + 0.25)
    assert float((whole - faint).detach().abs().max()) < 0.05 * float(whole.detach().abs().max())
    stored = classifiers.frozen(classifier, images)
    difference = stored(images) - stored(0.5 * images + 0.25)
    assert float(difference.detach().abs().max()) > 0.2 * float(whole.detach().abs().max())
    whole.sum().backward()
    assert images.grad.abs().max() > 0 and all(p.grad is None for p in frozen.parameters())
    state = frozen.state_dict()
    assert all(torch.equal(v, before[k]) for k, v in state.items() if "num_batches" not in k)


def test_a_frozen_copy_of_a_network_for_inference_judges_alike():
    """Without a graph its batch norms are not folded."""
    network = trained_network(0)
    network.forward = torch.no_grad()(network.forward)
    images, _ = random_images(12, 16, 3, seed=1).batch(torch.arange(12))
    torch.testing.assert_close(classifiers.frozen(network, images)(images), network(images), rtol=1e-5, atol=1e-5)


def test_a_batch_norm_without_statistics_cannot_be_frozen():
    network = nn.Sequential(nn.Conv2d(3, 4, 1), nn.BatchNorm2d(4, track_running_stats=False))
    with pytest.raises(InputError, match="without stored statistics: its answers depend on the batch"):
        classifiers.frozen(network, torch.zeros(1, 3, 8, 8))
