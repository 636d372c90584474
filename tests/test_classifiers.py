"""timm networks: built, loaded, frozen."""

import copy

import pytest
import timm
import torch
from examples import random_pictures, trained_network
from torch import nn

from tasklens.recognition import classifiers
from tasklens.settings import Classifier, Training
from tasklens.study import StudyError


@pytest.mark.parametrize(
    "model, arguments, size",
    [("resnt18", {}, 64), ("resnet18", {"chanels": [8]}, 64), ("vit_tiny_patch16_224", {"img_size": 64}, 80)],
)
def test_a_network_that_cannot_be_built_is_a_mistake_in_the_study(model, arguments, size):
    """An unknown model, an unknown argument, pictures of another size than the network's: before any weight is made."""
    classifier = Classifier(model=model, arguments=arguments, training=Training(epochs=1, rate=1e-3))
    with pytest.raises(StudyError, match=f"classifiers.mine: {model}"):
        classifiers.check("mine", classifier, size)
    classifiers.check("mine", Classifier(model="resnet18", pretrained=True), 64)


def test_a_published_head_for_other_classes_is_no_reference():
    """Without training it would judge at random; found before anything is downloaded."""
    with pytest.raises(StudyError, match="1000 classes, the pictures have 10"):
        classifiers.build(Classifier(model="resnet18.a1_in1k", pretrained=True), 10)


@pytest.mark.parametrize("model", ["resnet18", "vit_tiny_patch16_224.augreg_in21k_ft_in1k"])
def test_classifier_normalises_after_the_optics(model):
    """Logits of pictures in [0, 1] are those of the timm network on (x - mean) / std of its own configuration."""
    if model.startswith("vit"):
        small = {"img_size": 32, "embed_dim": 12, "depth": 1}
    else:
        small = {"layers": [1, 1, 1, 1], "channels": [8, 8, 8, 8]}
    torch.manual_seed(0)
    classifier = Classifier(model=model, arguments=small, training=Training(epochs=1, rate=1e-3))
    recogniser = classifiers.build(classifier, 7).eval()
    torch.manual_seed(0)
    network = timm.create_model(model, num_classes=7, **small).eval()
    config = timm.data.resolve_model_data_config(network)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    mean, std = (torch.tensor(config[k])[:, None, None] for k in ("mean", "std"))
    with torch.no_grad():
        torch.testing.assert_close(recogniser(images), network((images - mean) / std), rtol=1e-5, atol=1e-6)
    assert (config["mean"] == (0.5, 0.5, 0.5)) == model.startswith("vit")
    assert set(recogniser.network.state_dict()) == set(network.state_dict())
    assert classifiers.parameters_m(recogniser) == sum(p.numel() for p in network.parameters()) / 1e6


def test_weights_of_a_file_replace_all_others(tmp_path):
    from tasklens.files import write_tensors

    classifier = Classifier(model="test_resnet", training=Training(epochs=1, rate=1e-3))
    first = classifiers.build(classifier, 4).eval()
    path = tmp_path / "weights.safetensors"
    write_tensors(path, first.network.state_dict(), {})
    second = classifiers.build(classifier, 4, path).eval()
    images = torch.rand(2, 3, 32, 32)
    assert torch.equal(first(images), second(images))
    with pytest.raises(RuntimeError, match="size mismatch"):
        classifiers.build(classifier, 5, path)


@pytest.mark.parametrize("model", ["test_resnet", "test_efficientnet", "test_vit"])
def test_a_frozen_copy_judges_alike_and_remembers_less(model):
    """Same logits and gradients at the pictures; convolutional networks keep at most 0.7 of the memory for them."""
    torch.manual_seed(0)
    recogniser = classifiers.Recogniser(timm.create_model(model, num_classes=5)).double()
    for module in recogniser.modules():
        if isinstance(module, nn.BatchNorm2d):  # as after training: statistics that do something
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    size = recogniser.network.pretrained_cfg["input_size"][-1]
    images = torch.rand(2, 3, size, size, dtype=torch.float64)
    frozen, found = classifiers.frozen(recogniser), []
    assert recogniser.training and all(p.requires_grad for p in recogniser.parameters())
    assert not frozen.training and not any(p.requires_grad for p in frozen.parameters())
    for network in (frozen, recogniser.eval().requires_grad_(False)):
        kept: dict[int, int] = {}

        def keep(tensor, kept=kept):
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        leaf = images.clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            logits = network(leaf)
        logits.square().sum().backward()
        found.append((logits.detach(), leaf.grad, sum(kept.values())))
    for a, b in zip(found[0][:2], found[1][:2], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert found[0][2] <= (1.0 if model == "test_vit" else 0.7) * found[1][2]


def test_batch_norms_of_a_frozen_network_by_the_batch():
    """Captures of half the contrast give what the whole gives; nothing stored changes, and no weight has a gradient."""
    recogniser = trained_network(0)
    before = copy.deepcopy(recogniser.state_dict())
    frozen = classifiers.frozen(recogniser, "batch")
    images, _ = random_pictures(12, 16, 3, seed=1).batch(torch.arange(12))
    images.requires_grad_()
    whole, faint = frozen(images), frozen(0.5 * images + 0.25)
    assert float((whole - faint).abs().max()) < 0.05 * float(whole.abs().max())
    stored = classifiers.frozen(recogniser)
    assert float((stored(images) - stored(0.5 * images + 0.25)).abs().max()) > 0.2 * float(whole.abs().max())
    whole.sum().backward()
    assert images.grad.abs().max() > 0 and all(p.grad is None for p in frozen.parameters())
    state = frozen.state_dict()
    assert all(torch.equal(v, before[k]) for k, v in state.items() if "num_batches" not in k)
