"""Published networks of ImageNet's thousand classes that timm does not build by name: functions for `model`.

Their weights are converted by `python tools/convert_networks.py`.
"""

from timm.models.efficientnet import _gen_mobilenet_v1
from torch import nn
from torchvision.models import squeezenet1_0
from torchvision.transforms.v2 import Normalize


def mobilenet_v1(num_classes: int = 1000) -> nn.Module:
    """Build MobileNetV1 x 0.75 (Howard et al. 2017), for images (B, 3, H, W) in [0, 1]."""
    network = _gen_mobilenet_v1("mobilenetv1_075", 0.75, pad_type="same", num_classes=num_classes)
    return nn.Sequential(Normalize([0.5] * 3, [0.5] * 3), network)


def squeezenet(num_classes: int = 1000) -> nn.Module:
    """Build SqueezeNet 1.0 (Iandola et al. 2016) as in Caffe, for images (B, 3, H, W) in [0, 1]."""
    network = squeezenet1_0(num_classes=num_classes)
    network.classifier[1].padding = (1, 1)
    return network
