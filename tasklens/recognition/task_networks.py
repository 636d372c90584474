"""torchvision's networks for segmentation and detection, at full or reduced size."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.error import URLError

from torch import nn
from torchvision.models import get_model, get_model_weights
from torchvision.models.detection import FasterRCNN, MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
from torchvision.ops import MultiScaleRoIAlign

from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, read_tensors
from tasklens.settings.task_settings import TaskSettings

_LEVELS = 5  # levels of the pyramid: strides 4 to 64
_ANCHOR = 12  # side of the anchors of the first level [pixels]; each level doubles it
_CELLS, _MASK_CELLS = 7, 14  # side of the pooling grids of boxes and masks


def build(name: str, settings: TaskSettings, classes: int, size: int) -> nn.Module:
    """Build the network of a task.

    Args:
        name: name of the task, for errors.
        classes: number of classes, without the background.
        size: side of the images [pixels].

    Raises:
        InputError: torchvision has no such model, or the arguments do not fit it; the message names the task.
    """
    try:
        if settings.model is None:
            return _small_detector(settings, 1 + classes, size)
        weights = "DEFAULT" if settings.pretrained else None
        sizes = {} if settings.kind == "segmentation" else {"min_size": size, "max_size": size}
        arguments: dict[str, Any] = {"num_classes": 1 + classes, "weights_backbone": None} | sizes | settings.arguments
        if settings.pretrained:
            arguments.pop("num_classes")
        return get_model(settings.model, weights=weights, **arguments)
    except URLError as error:
        raise InputError(
            f"tasks.networks.{name}: the published weights of {settings.model} are not in torch's cache, and cannot be "
            f"downloaded ({error.reason}); put them there, or train the network (pretrained: false)"
        ) from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"tasks.networks.{name}: {settings.model or settings.backbone}: {error}") from error


def outputs(name: str, settings: TaskSettings, classes: Sequence[str]) -> tuple[int, ...]:
    """Return the network output of each class; output 0 is the background.

    Raises:
        InputError: the published weights lack one of the classes.
    """
    if not settings.pretrained:
        return tuple(range(1, 1 + len(classes)))
    categories = get_model_weights(settings.model).DEFAULT.meta["categories"]
    unknown = [label for label in classes if label not in categories]
    if unknown:
        raise InputError(
            f"tasks.networks.{name}: the published weights of {settings.model} have no class {', '.join(unknown)}, "
            f"only {', '.join(categories)}; rename the classes of the data, or train without `pretrained`"
        )
    return tuple(categories.index(label) for label in classes)


def load(name: str, settings: TaskSettings, classes: Sequence[str], size: int, weights: Path | None) -> nn.Module:
    """Build the network of a task, and load weights if there is a file; raises FileError if they do not fit."""
    network = build(name, settings, len(classes), size)
    if weights is not None:
        tensors, _ = read_tensors(weights)
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            raise FileError(f"{weights}: no weights for tasks.networks.{name}: {str(error).splitlines()[0]}") from error
    return network


def _small_detector(settings: TaskSettings, outputs: int, size: int) -> nn.Module:
    """Build a Faster or Mask R-CNN with a narrow pyramid, narrow heads and batch norms."""
    channels = settings.channels
    backbone = resnet_fpn_backbone(
        backbone_name=str(settings.backbone), weights=None, norm_layer=nn.BatchNorm2d, trainable_layers=5
    )
    widths = backbone.fpn.inner_blocks[-1][0].in_channels
    backbone.fpn = type(backbone.fpn)([widths // 2**k for k in (3, 2, 1, 0)], channels, backbone.fpn.extra_blocks)
    backbone.out_channels = channels
    levels = [str(level) for level in range(_LEVELS - 1)]
    anchors = AnchorGenerator(tuple((_ANCHOR * 2**k,) for k in range(_LEVELS)), ((0.5, 1.0, 2.0),) * _LEVELS)
    common: dict[str, Any] = {
        "rpn_anchor_generator": anchors,
        "box_roi_pool": MultiScaleRoIAlign(levels, _CELLS, 2),
        "box_head": TwoMLPHead(channels * _CELLS**2, 4 * channels),
        "box_predictor": FastRCNNPredictor(4 * channels, outputs),
        "min_size": size,
        "max_size": size,
        "rpn_pre_nms_top_n_train": 400,
        "rpn_pre_nms_top_n_test": 200,
        "rpn_post_nms_top_n_train": 200,
        "rpn_post_nms_top_n_test": 100,
        "rpn_batch_size_per_image": 64,
        "box_batch_size_per_image": 64,
        "box_detections_per_img": 20,
    }
    if settings.kind == "detection":
        return FasterRCNN(backbone, **(common | settings.arguments))
    masks = {
        "mask_roi_pool": MultiScaleRoIAlign(levels, _MASK_CELLS, 2),
        "mask_head": MaskRCNNHeads(channels, (channels, channels), 1),
        "mask_predictor": MaskRCNNPredictor(channels, channels, outputs),
    }
    return MaskRCNN(backbone, **(common | masks | settings.arguments))


def frozen(network: nn.Module) -> nn.Module:
    """Freeze a network that returns losses: in `train()` except for batch norms and dropout, no parameter gradients."""
    network.train().requires_grad_(False)
    for module in network.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm | nn.Dropout):
            module.eval()
    return network
