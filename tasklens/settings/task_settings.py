"""Settings of tasks other than classification: segmentation and detection of objects; no torch here."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from tasklens.settings.base import Count, Frozen, Name, Periods, Seed, Small, Whole
from tasklens.settings.network_settings import TrainingSettings


class SceneSettings(Frozen):
    """Settings of images with objects: rendered, or read from `folder` in the format of COCO.

    A folder has annotations/instances_<split>.json and <split>/*; splits are train2017 and val2017, or train and val.
    """

    size: Whole = Field(128, ge=32, le=4096, multiple_of=32, description="Side of the square images [pixels].")
    train: Count = Field(2000, description="Number of training images; for a folder the maximum.")
    test: Count = Field(300, description="Number of test images; for a folder the maximum.")
    seed: Seed = Field(0, description="Seed of the rendering, or of the choice of a folder's images.")
    folder: Path | None = Field(None, description="Folder in the format of COCO; null: rendered objects.")
    periods: Periods = Field(
        (5.0, 16.0), description="Shortest and longest period of rendered textures [pixels]; shorter ones are harder."
    )


class TaskSettings(Frozen):
    """Settings of a task: its kind, its network from torchvision, and the training of the network."""

    kind: Literal["segmentation", "detection", "instance_segmentation"] = Field(
        description="segmentation: class of each pixel (mIoU); detection: boxes of objects (box AP); "
        "instance_segmentation: boxes and masks (box and mask AP)."
    )
    model: str | None = Field(
        None,
        description="torchvision's name of the whole network, such as deeplabv3_resnet50 or maskrcnn_resnet50_fpn; "
        "null: a small Faster or Mask R-CNN on `backbone`.",
    )
    backbone: str | None = Field(
        None, description="torchvision's name of the ResNet in a small detector, such as resnet18."
    )
    channels: Annotated[Small, Field(ge=8)] = Field(64, description="Channels of a small detector's pyramid and heads.")
    pretrained: bool = Field(
        False,
        description="Start from torchvision's published weights of the whole network; its classes are matched by name.",
    )
    arguments: dict[str, Any] = Field({}, description="Further keywords of the network, such as box_score_thresh.")
    training: TrainingSettings = Field(description="Training on the sharp images.")
    fine_tuning: TrainingSettings = Field(description="Fine-tuning on the captures of each lens.")

    @model_validator(mode="after")
    def _one_network(self) -> "TaskSettings":
        if (self.model is None) == (self.backbone is None):
            raise ValueError("expected either `model`, a whole network, or `backbone`, for a small detector")
        if self.backbone is not None and self.kind == "segmentation":
            raise ValueError("model: segmentation needs a whole network, such as lraspp_mobilenet_v3_large")
        if self.pretrained and self.model is None:
            raise ValueError("pretrained: a small detector has no published weights")
        if self.model is not None and self.channels != type(self).model_fields["channels"].default:
            raise ValueError("channels: only for a small detector on `backbone`; a whole network has its own")
        return self


class TasksSettings(Frozen):
    """Settings of the tasks other than classification: their images, networks and lenses."""

    scenes: SceneSettings = Field(SceneSettings(), description="Images with objects.")
    networks: dict[Name, TaskSettings] = Field(default_factory=dict, description="Tasks and their networks by name.")
    designs: tuple[str, ...] | None = Field(
        None,
        description="Designs, imported lenses, or single lenses such as doublet-tasklens, to measure on the tasks; "
        "null: all of table 1, and those designed for a task.",
    )
