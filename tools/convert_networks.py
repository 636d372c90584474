"""Convert published weights, quantised or compressed, to files that a study reads.

    python tools/convert_networks.py mobilenet_v1 mobilenet_v1_0.75_192_quant.tflite mobilenet_v1.safetensors
    python tools/convert_networks.py mobilenet_v2 mobilenet_v2_1.0_224_quant.tflite mobilenet_v2.safetensors
    python tools/convert_networks.py squeezenet compressed_SqueezeNet.net squeezenet.safetensors

The first two are of google-coral/test_data and need `pip install tflite`; the third is of
songhan/SqueezeNet-Deep-Compression (Han, Mao and Dally 2016, https://arxiv.org/abs/1510.00149).
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy
import timm
import torch
from published_networks import mobilenet_v1, squeezenet
from safetensors.torch import save_file
from torch import Tensor, nn

_CODES = 256  # weights that a layer of the compressed file shares
_MEAN_BGR = (104.0, 117.0, 123.0)  # of the pixels that SqueezeNet was trained with


def mobilenet_state(file: Path, network: nn.Module) -> dict[str, Tensor]:
    """Return the state of a MobileNet of timm from a TFLite file: dequantised, batch norms the identity but for biases.

    A weight is scale (q - zero point). The first of the 1001 outputs, the background, is left out.
    """
    layers = tflite_layers(file)
    convolutions = [module for module in network.modules() if isinstance(module, nn.Conv2d)]  # as they run
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    with torch.no_grad():
        for convolution, norm in zip(convolutions, norms, strict=True):
            weight, bias = next(layers)
            depthwise = convolution.groups > 1
            convolution.weight.copy_(weight.permute(3, 0, 1, 2) if depthwise else weight.permute(0, 3, 1, 2))
            norm.bias.copy_(bias)
            norm.running_var.fill_(1 - norm.eps)  # it divides by the square root of 1
        weight, bias = next(layers)
        network.classifier.weight.copy_(weight[1:, 0, 0])
        network.classifier.bias.copy_(bias[1:])
    return dict(network.state_dict())


def mobilenet_v1_state(file: Path) -> dict[str, Tensor]:
    """Return the state of `mobilenet_v1`."""
    state = mobilenet_state(file, mobilenet_v1()[1])
    return {f"1.{name}": value for name, value in state.items()}  # behind the normalisation


def mobilenet_v2_state(file: Path) -> dict[str, Tensor]:
    """Return the state of timm's `mobilenetv2_100` with `pad_type: same`, for inputs in [-1, 1]."""
    return mobilenet_state(file, timm.create_model("mobilenetv2_100", pad_type="same"))


def tflite_layers(file: Path) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield weights (O, H, W, I), or (1, H, W, C) of a depthwise convolution, and biases (O,) of convolutions."""
    import tflite

    model = tflite.Model.GetRootAs(file.read_bytes(), 0)
    graph = model.Subgraphs(0)
    kinds = tflite.BuiltinOperator.CONV_2D, tflite.BuiltinOperator.DEPTHWISE_CONV_2D

    def values(index: int, dtype: type) -> Tensor:
        tensor = graph.Tensors(index)
        numbers = numpy.frombuffer(model.Buffers(tensor.Buffer()).DataAsNumpy(), dtype).reshape(tensor.ShapeAsNumpy())
        quantisation = tensor.Quantization()
        return torch.from_numpy((numbers.astype(float) - quantisation.ZeroPoint(0)) * quantisation.Scale(0)).float()

    for k in range(graph.OperatorsLength()):
        operator = graph.Operators(k)
        if model.OperatorCodes(operator.OpcodeIndex()).DeprecatedBuiltinCode() in kinds:
            yield values(operator.Inputs(1), numpy.uint8), values(operator.Inputs(2), numpy.int32)


def squeezenet_state(file: Path) -> dict[str, Tensor]:
    """Return the state of `squeezenet` from a file of deep compression; its inputs become RGB in [0, 1].

    The file has the number of weights of each layer that are not pruned, and for each layer a codebook, biases, a code
    for each weight, and the distance of each weight from the one before, two in a byte.
    """
    data, network = file.read_bytes(), squeezenet().eval()
    layers = [module for module in network.modules() if isinstance(module, nn.Conv2d)]
    begin = 0

    def read(dtype: type, count: int) -> numpy.ndarray:
        nonlocal begin
        begin += (size := count * numpy.dtype(dtype).itemsize)
        return numpy.frombuffer(data[begin - size : begin], dtype)

    with torch.no_grad():
        for layer, count in zip(layers, read(numpy.uint32, len(layers)).tolist(), strict=True):
            codebook, bias = read(numpy.float32, _CODES), read(numpy.float32, layer.out_channels)
            codes, pairs = read(numpy.uint8, count), read(numpy.uint8, (count + 1) // 2)
            distances = numpy.stack([pairs % 16, pairs // 16], 1).ravel()[:count]
            weights = numpy.full(layer.weight.numel(), codebook[0])
            weights[(distances.astype(int) + 1).cumsum() - 1] = codebook[codes]
            layer.weight.copy_(torch.from_numpy(weights).reshape(layer.weight.shape))
            layer.bias.copy_(torch.from_numpy(bias.copy()))
        first = layers[0]  # without padding, so that the mean of the pixels moves into its biases
        first.bias.sub_((first.weight.sum((-2, -1)) * torch.tensor(_MEAN_BGR)).sum(-1))
        first.weight.copy_(255 * first.weight.flip(1))
    if begin != len(data):
        raise ValueError(f"{file}: has {len(data)} bytes, of which SqueezeNet takes {begin}")
    return network.state_dict()


NETWORKS: dict[str, Callable[[Path], dict[str, Tensor]]] = {
    "mobilenet_v1": mobilenet_v1_state,
    "mobilenet_v2": mobilenet_v2_state,
    "squeezenet": squeezenet_state,
}


def main() -> None:
    """Convert a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("file", type=Path, help="the published file")
    parser.add_argument("output", type=Path, help="the file to write, .safetensors")
    options = parser.parse_args()
    state = NETWORKS[options.network](options.file)
    save_file({name: value.contiguous() for name, value in state.items()}, options.output)


if __name__ == "__main__":
    main()
