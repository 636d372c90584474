"""Programs that prepare data: sets of classes as links, and published networks read from compressed files."""

import sys
from functools import partial
from pathlib import Path

import numpy
import pytest
import timm
import torch
from examples import write
from torch import nn

sys.path.append(str(Path(__file__).parents[1] / "tools"))
import convert_networks
from class_sets import main
from convert_networks import squeezenet_state
from published_networks import mobilenet_v1, squeezenet


@pytest.fixture
def data_sets(tmp_path):
    """Two data sets of four classes with three training photographs and one for tests."""
    for k in range(8):
        for name in ("train/{}/a", "train/{}/b", "train/{}/c", "val/{}/t"):
            write(tmp_path / f"set{k // 4}" / name.format(f"n{k}"), "a photograph")
    return [str(tmp_path / f"set{k}") for k in (0, 1)]


def test_sets_of_classes(tmp_path, data_sets):
    """Each data set, and pairs of halves of all classes; links to at most two training photographs of a class."""
    main([*data_sets, "-o", str(tmp_path / "sets"), "--mixed", "4", "--each", "2"])
    classes = {
        folder.name: {path.name for path in (folder / "val").iterdir()} for folder in (tmp_path / "sets").iterdir()
    }
    assert classes.keys() == {"set0", "set1", "mixed1", "mixed2", "mixed3", "mixed4"}
    assert classes["set0"] == {"n0", "n1", "n2", "n3"} and classes["mixed1"] != classes["mixed3"]
    for pair in (("mixed1", "mixed2"), ("mixed3", "mixed4")):
        assert sorted([*classes[pair[0]], *classes[pair[1]]]) == [f"n{k}" for k in range(8)]
    assert [path.name for path in sorted((tmp_path / "sets/set1/train/n5").iterdir())] == ["a", "b"]
    assert (tmp_path / "sets/set1/val/n5/t").read_text() == "a photograph"


@pytest.mark.parametrize("options, words", [(["--test", "test"], "no such folder"), (["--mixed", "3"], "even number")])
def test_what_cannot_be_a_set_is_named(tmp_path, data_sets, options, words):
    with pytest.raises(SystemExit, match=words):
        main([*data_sets, "-o", str(tmp_path / "sets"), *options])
    for other, reason in ((data_sets[0], "the same name"), (str(tmp_path), "train: no such folder")):
        with pytest.raises(SystemExit, match=reason):
            main([data_sets[0], other, "-o", str(tmp_path / "sets")])
    Path(data_sets[1], "train/n4").rename(Path(data_sets[1], "train/n0"))
    with pytest.raises(SystemExit, match="class of two data sets"):
        main([*data_sets, "-o", str(tmp_path / "sets")])
    assert not (tmp_path / "sets").exists()


@pytest.mark.parametrize("name", ["mobilenet_v1", "mobilenet_v2"])
def test_a_quantised_network_is_read(monkeypatch, name):
    """Layers with folded batch norms, in the order and layout of TFLite: the answers of the network before."""
    torch.manual_seed(0)
    v2 = partial(timm.create_model, "mobilenetv2_100", pad_type="same")
    built = {"mobilenet_v1": lambda: mobilenet_v1()[1], "mobilenet_v2": v2}
    network = built[name]().eval()
    layers, convolutions = [], [module for module in network.modules() if isinstance(module, nn.Conv2d)]
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    with torch.no_grad():
        for convolution, norm in zip(convolutions, norms, strict=True):
            nn.init.uniform_(norm.running_var, 0.5, 2)
            nn.init.normal_(norm.bias, std=0.1)
            factor = norm.weight / (norm.running_var + norm.eps).sqrt()
            weight = convolution.weight * factor[:, None, None, None]
            order = (1, 2, 3, 0) if convolution.groups > 1 else (0, 2, 3, 1)
            layers.append((weight.permute(order), norm.bias - norm.running_mean * factor))
        last = network.classifier
        layers.append((torch.cat([last.weight[:1], last.weight])[:, None, None], torch.cat([last.bias[:1], last.bias])))
    monkeypatch.setattr(convert_networks, "tflite_layers", lambda file: iter(layers))
    read = mobilenet_v1() if name == "mobilenet_v1" else built[name]()
    read.load_state_dict(convert_networks.NETWORKS[name](Path("none.tflite")))
    images = torch.rand(2, 3, 96, 96)
    with torch.no_grad():
        actual = read.eval()(images if name == "mobilenet_v1" else 2 * images - 1)
        torch.testing.assert_close(actual, network(2 * images - 1), rtol=1e-4, atol=1e-4)


def test_a_compressed_network_is_read(tmp_path):
    """Random codes at random distances, written layer by layer; inputs change from BGR of 0 to 255 to RGB of 0 to 1."""
    random, network = numpy.random.default_rng(0), squeezenet().eval()
    layers = [module for module in network.modules() if isinstance(module, nn.Conv2d)]
    header, body = [], b""
    with torch.no_grad():
        for layer in layers:
            codebook = numpy.append(0.0, random.normal(0, 0.1, 255)).astype(numpy.float32)
            distances = random.integers(0, 16, layer.weight.numel() // 16)
            codes = random.integers(0, 256, len(distances))
            weights = numpy.zeros(layer.weight.numel(), numpy.float32)
            weights[(distances + 1).cumsum() - 1] = codebook[codes]
            layer.weight.copy_(torch.from_numpy(weights).reshape(layer.weight.shape))
            low, high = (numpy.append(distances, 0)[k : len(distances) + len(distances) % 2 : 2] for k in (0, 1))
            header.append(len(distances))
            parts = (codebook, layer.bias.numpy(), codes.astype(numpy.uint8), (low + 16 * high).astype(numpy.uint8))
            body += b"".join(part.tobytes() for part in parts)
    path = tmp_path / "compressed.net"
    path.write_bytes(numpy.array(header, numpy.uint32).tobytes() + body)
    read = squeezenet().eval()
    read.load_state_dict(squeezenet_state(path))
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    mean = torch.tensor([104.0, 117.0, 123.0])[:, None, None]
    with torch.no_grad():
        torch.testing.assert_close(read(images), network(255 * images.flip(1) - mean), rtol=1e-4, atol=1e-4)
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(ValueError, match=r"compressed\.net: has \d+ bytes"):
        squeezenet_state(path)
