"""A frozen copy of a network gives the same answers, and gradients to images alone."""

import copy

import pytest
import timm
import torch
from examples import random_images, trained_network
from torch import nn

from tasklens.recognition import classifiers
from tasklens.runtime.errors import InputError


@pytest.mark.parametrize("model", ["test_resnet", "test_vit"])
def test_a_frozen_copy_judges_alike_and_remembers_less(model):
    """Same logits and gradients at the images; convolutional networks save at most 0.7 of the bytes for them."""
    torch.manual_seed(0)
    classifier = classifiers.Classifier(timm.create_model(model, num_classes=5)).double()
    for module in classifier.modules():
        if isinstance(module, nn.BatchNorm2d):  # nontrivial statistics, as after training
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    size = classifier.network.pretrained_cfg["input_size"][-1]
    images = torch.rand(2, 3, size, size, dtype=torch.float64)
    frozen, results = classifiers.frozen(classifier, images), []
    assert classifier.training and all(p.requires_grad for p in classifier.parameters())
    assert not frozen.training and not any(p.requires_grad for p in frozen.parameters())
    for network in (frozen, classifier.eval().requires_grad_(False)):
        sizes: dict[int, int] = {}

        def keep(tensor, sizes=sizes):
            sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        leaf = images.clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            logits = network(leaf)
        logits.square().sum().backward()
        results.append((logits.detach(), leaf.grad, sum(sizes.values())))
    for a, b in zip(results[0][:2], results[1][:2], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert results[0][2] <= (1.0 if model == "test_vit" else 0.7) * results[1][2]


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
