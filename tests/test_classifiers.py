"""Networks of timm or of one's own are built, and weights are loaded into them."""

import re
import sys
from pathlib import Path

import numpy
import pytest
import timm
import torch
from safetensors.torch import save_file
from studies import changed, tiny_study

from tasklens.recognition import classifiers, evaluation, folders, image_tensors, networks
from tasklens.recognition import dataset as data
from tasklens.runtime import user_code
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, write_tensors
from tasklens.settings.network_settings import ClassifierSettings, TrainingSettings
from tasklens.study.loading import parse
from tasklens.study.run import checks

SHARED = Path(__file__).parents[2] / "shared"


def names(count: int) -> list[str]:
    return [f"class{k}" for k in range(count)]


def settings_of(model: str = "test_resnet", **keys) -> ClassifierSettings:
    """Settings of a network that is trained for an epoch."""
    return ClassifierSettings(model=model, training=TrainingSettings(epochs=1, learning_rate=1e-3), **keys)


@pytest.mark.parametrize(
    "model, arguments, size",
    [("resnt18", {}, 64), ("resnet18", {"chanels": [8]}, 64), ("vit_tiny_patch16_224", {"img_size": 64}, 80)],
)
def test_a_network_that_cannot_be_built_is_a_mistake_in_the_study(model, arguments, size):
    """Unknown model, unknown argument, wrong image size: refused before any weight is initialised."""
    with pytest.raises(InputError, match=f"classifiers.mine: {model}"):
        classifiers.check("mine", settings_of(model, arguments=arguments), size)
    classifiers.check("mine", ClassifierSettings(model="resnet18", pretrained=True), 64)


def test_a_supervisor_is_built_for_every_size_that_it_sees():
    """A ViT has a fixed size; a descent on the image error may use another size, since no network sees its images."""
    vit = {"model": "vit_tiny_patch16_224", "arguments": {"img_size": 16, "patch_size": 8}, "weights": "/nowhere"}
    study = changed(changed(tiny_study(), "supervisor", "other"), "classifiers.other", vit)
    study = changed(study, "designs.image_error.descents.0.size", 8)
    checks.check(parse(study), networks=True, weights=False)
    study = changed(study, "designs.tasklens.descents.2.size", 8)
    with pytest.raises(InputError, match=r"other for designs\.tasklens\.descents\.2\.size.*8"):
        checks.check(parse(study), networks=True, weights=False)


def test_a_published_head_for_other_classes_is_no_reference():
    """Untrained, it would classify at random; the error comes before any download."""
    for training in (None, {"epochs": 0, "learning_rate": 1e-3}):
        settings = ClassifierSettings(model="resnet18.a1_in1k", pretrained=True, training=training)
        with pytest.raises(InputError, match="1000 outputs, but 10 are needed"):
            classifiers.build(settings, names(10))


@pytest.mark.parametrize("model", ["resnet18", "vit_tiny_patch16_224.augreg_in21k_ft_in1k"])
def test_classifier_normalises_after_the_optics(model):
    """Logits of images in [0, 1] equal those of the timm network for (x - mean) / std of its configuration."""
    if model.startswith("vit"):
        small = {"img_size": 32, "embed_dim": 12, "depth": 1}
    else:
        small = {"layers": [1, 1, 1, 1], "channels": [8, 8, 8, 8]}
    torch.manual_seed(0)
    classifier = classifiers.build(settings_of(model, arguments=small), names(7)).eval()
    torch.manual_seed(0)
    network = timm.create_model(model, num_classes=7, **small).eval()
    config = timm.data.resolve_model_data_config(network)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    mean, std = (torch.tensor(config[k])[:, None, None] for k in ("mean", "std"))
    with torch.no_grad():
        torch.testing.assert_close(classifier(images), network((images - mean) / std), rtol=1e-5, atol=1e-6)
    assert (config["mean"] == (0.5, 0.5, 0.5)) == model.startswith("vit")
    assert set(classifier.network.state_dict()) == set(network.state_dict())
    assert classifiers.parameters_m(classifier) == sum(p.numel() for p in network.parameters()) / 1e6


def test_weights_of_a_file_replace_all_others(tmp_path):
    settings = settings_of()
    first = classifiers.build(settings, names(4)).eval()
    path = tmp_path / "weights.safetensors"
    write_tensors(path, first.network.state_dict(), {})
    second = classifiers.build(settings, names(4), path).eval()
    images = torch.rand(2, 3, 32, 32)
    assert torch.equal(first(images), second(images))
    with pytest.raises(FileError, match=r"weights\.safetensors: no weights for test_resnet with 5 outputs"):
        classifiers.build(settings, names(5), path)


def _state() -> dict[str, torch.Tensor]:
    return timm.create_model("test_resnet", num_classes=4).state_dict()


@pytest.mark.parametrize(
    "write, words",
    [
        (lambda path: torch.save({"state_dict": _state(), "acc": numpy.float64(0.9)}, path), "save only the weights"),
        (lambda path: torch.save({f"model.{k}": v for k, v in _state().items()}, path), "begin with 'model.': remove"),
        (lambda path: path.write_bytes(b""), "the file is empty"),
        (lambda path: path.write_text("hello"), "it is not a file of weights (.safetensors, .pth, .npz)"),
    ],
    ids=["objects", "prefix", "empty", "text"],
)
def test_what_holds_no_weights_says_what_to_do(tmp_path, write, words):
    write(tmp_path / "w.pth")
    with pytest.raises(FileError, match=rf"w\.pth: no weights for test_resnet with 4 outputs: .*{re.escape(words)}"):
        classifiers.build(settings_of(), names(4), tmp_path / "w.pth")


def test_weights_of_torch_are_tensors_and_nothing_else(tmp_path):
    """A training checkpoint with `state_dict` from several GPUs is read; one that would run code is refused."""
    network = timm.create_model("test_resnet", num_classes=4)
    state = {f"module.{key}": value for key, value in network.state_dict().items()}
    torch.save({"state_dict": state, "epoch": 3}, tmp_path / "mine.pth")
    settings = ClassifierSettings(model="test_resnet", weights=tmp_path / "mine.pth")
    weights = classifiers.build(settings, names(4)).network.state_dict()
    assert all(torch.equal(weights[key], value) for key, value in network.state_dict().items())
    torch.save({"state_dict": network.state_dict(), "model": network}, tmp_path / "mine.pth")
    with pytest.raises(FileError, match=r"mine\.pth"):
        classifiers.build(settings, names(4))
    (tmp_path / "mine.pth").unlink()
    with pytest.raises(FileNotFoundError):
        classifiers.build(settings, names(4))


def test_weights_of_numpy_are_read_by_models_that_can(tmp_path):
    """Vision transformers read their published .npz files; a ResNet says that it cannot."""
    small = {"img_size": 32, "embed_dim": 12, "num_heads": 1, "depth": 1}
    d, block = 12, "Transformer/encoderblock_0"
    attention, dense = f"{block}/MultiHeadDotProductAttention_1", f"{block}/MlpBlock_3/Dense"
    shapes = {"cls": (1, 1, d), "Transformer/posembed_input/pos_embedding": (1, 5, d)}
    shapes |= {"embedding/kernel": (16, 16, 3, d), "embedding/bias": d, "head/kernel": (d, 3)}
    shapes |= {f"{attention}/out/kernel": (1, d, d), f"{attention}/out/bias": d}
    shapes |= {f"{dense}_0/kernel": (d, 4 * d), f"{dense}_0/bias": 4 * d}
    shapes |= {f"{dense}_1/kernel": (4 * d, d), f"{dense}_1/bias": d}
    for norm in (f"{block}/LayerNorm_0", f"{block}/LayerNorm_2", "Transformer/encoder_norm"):
        shapes |= {f"{norm}/scale": d, f"{norm}/bias": d}
    for part in ("query", "key", "value"):
        shapes |= {f"{attention}/{part}/kernel": (d, 1, d), f"{attention}/{part}/bias": (1, d)}
    arrays = {name: numpy.zeros(shape) for name, shape in shapes.items()}
    numpy.savez(tmp_path / "vit.npz", **arrays | {"head/bias": numpy.array([1.0, 2.0, 3.0])})
    vit = ClassifierSettings(model="vit_tiny_patch16_224", arguments=small, weights=tmp_path / "vit.npz")
    logits = classifiers.build(vit, names(3)).eval()(torch.rand(2, 3, 32, 32))
    torch.testing.assert_close(logits, torch.tensor([[1.0, 2.0, 3.0]] * 2))
    with pytest.raises(FileError, match=r"vit\.npz: its head is not that of vit_tiny_patch16_224 with 4 outputs"):
        classifiers.build(vit, names(4))
    with pytest.raises(FileError, match=r"vit\.npz: no weights for test_resnet"):
        classifiers.build(ClassifierSettings(model="test_resnet", weights=tmp_path / "vit.npz"), names(3))


def test_ten_of_imagenets_classes_are_asked_alone(tmp_path):
    """Logits of the present classes, in the order of the folders; only their rows of the head have gradients."""
    settings = settings_of(outputs="imagenet")
    folders = ["n01443537", "n02102040", "n01440764"]  # goldfish (1), English springer (217), tench (0)
    classifier = classifiers.build(settings, folders).eval()
    assert classifier.outputs.tolist() == [1, 217, 0]
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    assert torch.equal(classifier(images), classifier.all_outputs(images)[:, [1, 217, 0]])
    classifier(images).sum().backward()
    moved = classifier.network.get_classifier().weight.grad.abs().sum(1).nonzero()[:, 0]
    assert moved.tolist() == [0, 1, 217]
    with pytest.raises(FileError, match="got cat"):
        classifiers.build(settings, ["cat", "n01440764"])
    # With `all_imagenet` present classes come first, so that labels index them; then the others, each once.
    everything = classifiers.build(settings_of(outputs="all_imagenet"), folders).outputs
    assert everything[:5].tolist() == [1, 217, 0, 2, 3]
    assert everything.sort().values.tolist() == list(range(1000))


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="needs photographs and weights that we do not distribute")
def test_published_weights_reproduce_their_accuracy():
    """MobileNetV2 on sharp photographs of Imagenette at 224 pixels: 99.0 % of ten classes, 75.6 % of a thousand."""
    weights = SHARED / "weights" / "mobilenetv2_100_same_in1k.safetensors"
    normalised = {"mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5)}
    arguments = {"pad_type": "same", "pretrained_cfg_overlay": normalised}
    settings = ClassifierSettings(model="mobilenetv2_100", arguments=arguments, weights=weights, outputs="imagenet")
    result = folders.find(SHARED / "data" / "imagenette" / "val", None, 0)
    images = torch.stack([image_tensors.read(file, 224) for file in result.files])
    dataset = data.ImageDataset(images, result.labels, result.classes)
    classifier = classifiers.build(settings, result.classes).eval()
    result = evaluation.evaluate(classifier, dataset, evaluation.CapturePipeline())
    assert float(result.correct.double().mean()) == pytest.approx(0.990, abs=0.0041)
    assert classifier.has_more_outputs
    assert float(result.among_all.double().mean()) == pytest.approx(0.756, abs=0.0041)


def test_a_hub_out_of_reach_is_reported_at_once(monkeypatch):
    """At once, without a minute of retries; with cached weights the hub is not contacted."""
    asked = []

    def refuse(address, timeout):
        asked.append(address)
        raise OSError("Name or service not known")

    monkeypatch.setattr(networks.socket, "create_connection", refuse)
    monkeypatch.setattr(networks.urllib.request, "getproxies", dict)
    monkeypatch.setattr(networks.huggingface_hub, "try_to_load_from_cache", lambda *_: None)
    settings = ClassifierSettings(model="resnet18.a1_in1k", pretrained=True, outputs="imagenet")
    with pytest.raises(InputError, match=r"resnet18\.a1_in1k: .* cannot be reached .*not known.*`weights`") as error:
        classifiers.build(settings, ["n01440764"])
    assert len(asked) == 1 and asked[0][0] in str(error.value)
    monkeypatch.setattr(networks.huggingface_hub, "try_to_load_from_cache", lambda *_: "there")
    networks.check_published("resnet18.a1_in1k")
    networks.check_published("test_resnet")  # has none
    assert len(asked) == 1


OWN = """
from torch import nn
def small(num_classes, width=8):
    pooled = nn.Sequential(nn.Conv2d(3, width, 3, 2), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten())
    return nn.Sequential(pooled, nn.Linear(width, num_classes))
def detached(num_classes):
    class Network(nn.Module):
        def forward(self, images):
            return images.detach().mean((2, 3))[:, :1].expand(-1, num_classes) + 0
    return Network()
def features(num_classes):
    return nn.Sequential(nn.Conv2d(3, num_classes, 3), nn.ReLU())
def number(num_classes):
    return 7
"""


@pytest.fixture
def own_module(here, monkeypatch):
    """A module of the user in the current folder."""
    monkeypatch.setattr(sys, "path", sys.path[:])
    (here / "own_networks.py").write_text(OWN)
    yield
    sys.modules.pop("own_networks", None)


def test_a_function_of_ones_own_makes_a_network(own_module, tmp_path):
    """For images in [0, 1], without a normalisation; weights come from a file, its source is in the settings."""
    settings = ClassifierSettings(
        model="own_networks:small", arguments={"width": 4}, weights=tmp_path / "mine.safetensors"
    )
    torch.manual_seed(0)
    network = user_code.load(settings.model)(3, 4).eval()
    save_file(network.state_dict(), settings.weights)
    images = torch.rand(2, 3, 16, 16)
    torch.testing.assert_close(classifiers.build(settings, names(3)).eval()(images), network(images), rtol=0, atol=1e-6)
    with pytest.raises(FileError, match="no weights for own_networks:small with 4 outputs"):
        classifiers.build(settings, names(4))
    with pytest.raises(ValueError, match="pretrained: only for networks of timm"):
        ClassifierSettings(model="own_networks:small", pretrained=True)
    before = settings.model_dump_json()
    (tmp_path / "own_networks.py").write_text(OWN + "\n# changed")
    assert settings.model_dump_json() != before


@pytest.mark.parametrize(
    "function, words",
    [
        ("absent", "expected package.module:function, installed, in this folder or on PYTHONPATH"),
        ("number", "expected a torch.nn.Module, got int"),
        ("features", "returns a tensor .1, 10, 30, 30. for 1 image of 10 classes; expected logits .1, 10."),
        ("detached", "has no gradient with respect to its images"),
    ],
)
def test_a_function_that_makes_no_classifier_is_refused(own_module, function, words):
    with pytest.raises(InputError, match=rf"classifiers\.mine: own_networks:{function}: .*{words}"):
        classifiers.check("mine", ClassifierSettings(model=f"own_networks:{function}"), 32)


def test_a_file_in_place_of_a_module_is_refused():
    with pytest.raises(InputError, match=r"expected a module, not a file: nets:build"):
        user_code.load("./nets.py:build")


def test_weights_with_the_head_of_imagenet(tmp_path):
    """With images of ten classes, the message names the setting that accepts its thousand outputs."""
    path = tmp_path / "published.safetensors"
    save_file(timm.create_model("test_resnet", num_classes=1000).state_dict(), path)
    with pytest.raises(FileError, match="its head has 1000 outputs: for those of ImageNet, set `outputs: imagenet`"):
        classifiers.build(ClassifierSettings(model="test_resnet", weights=path), names(10))
    with pytest.raises(FileError, match="size mismatch"):
        classifiers.build(ClassifierSettings(model="test_resnet", weights=path, arguments={"in_chans": 1}), names(1000))
