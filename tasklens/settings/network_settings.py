"""Settings of networks and their training, for classification and restoration; no torch here."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, computed_field, model_validator

from tasklens.runtime import user_code
from tasklens.settings.base import Batch, Fraction, Frozen, LearningRate, Seed, Small, Steps, Whole


class TrainingSettings(Frozen):
    """Settings of AdamW with linear warm-up and cosine schedule; biases and norms have no weight decay."""

    epochs: float = Field(
        ge=0, le=10_000, description="Epochs, possibly fractional; 0: no training, as in a zero-shot study."
    )
    learning_rate: LearningRate = Field(description="Largest learning rate, after the warm-up.")
    batch_size: Batch = Field(64, description="Images per step.")
    weight_decay: float = Field(
        0.05, ge=0, le=100, description="Weight decay of AdamW; not of biases, norms and what timm's models exempt."
    )
    warmup: Fraction = Field(0.05, description="Fraction of the steps in which the learning rate rises linearly.")


class ClassifierSettings(Frozen):
    """Settings of a timm network: its name and tag, keywords for `timm.create_model`, and the source of its weights."""

    model: str = Field(
        description="timm's name of the network, with the tag of its weights; or `package.module:function`, a function "
        "of your own that takes `num_classes` and returns a module for images in [0, 1]."
    )
    arguments: dict[str, Any] = Field(
        {},
        description="Keywords for `timm.create_model`, such as a smaller width, or for your function. "
        "`pretrained_cfg_overlay: {mean: [0.5, 0.5, 0.5], std: [0.5, 0.5, 0.5]}` sets another normalisation.",
    )
    seed: Seed = Field(0, description="Seed of its initial weights, and of its training on sharp images.")
    pretrained: bool = Field(False, description="Start from the weights of timm's hub.")
    weights: Path | None = Field(
        None,
        description="Start from a local file: .safetensors; .pth, of which only tensors are read; .npz, if timm's "
        "model reads it.",
    )
    outputs: Literal["classes", "imagenet", "all_imagenet"] = Field(
        "classes",
        description="classes: one output per class of the images; imagenet: ImageNet's 1000 outputs, of which only "
        "those of the folders, named by WordNet ids, are used, while the others count only in the zero-shot accuracy; "
        "all_imagenet: any of the 1000 may be the answer, right or wrong.",
    )
    training: TrainingSettings | None = Field(None, description="Training on the sharp images; null: none.")

    @computed_field
    @property
    def code(self) -> str | None:
        """Digest of the file of a user's function."""
        return user_code.digest(self.model)

    @model_validator(mode="before")
    @classmethod
    def _of_one_process(cls, value: Any) -> Any:
        """Leave out the default of a key that version 1.0 stored with every study."""
        if isinstance(value, dict) and value.get("processes") == 1:
            return {key: entry for key, entry in value.items() if key != "processes"}
        return value

    @model_validator(mode="after")
    def _one_origin(self) -> "ClassifierSettings":
        if self.pretrained and self.weights:
            raise ValueError("expected either `pretrained` or `weights`, not both")
        if self.pretrained and user_code.is_users(self.model):
            raise ValueError("pretrained: only for networks of timm; your function may load weights, or `weights`")
        trained = self.pretrained or self.weights or (self.training and self.training.epochs)
        if not trained and not user_code.is_users(self.model):  # a function may return a trained network
            raise ValueError("expected `pretrained`, `weights` or `training`: an untrained network classifies nothing")
        return self


class RestorationSettings(Frozen):
    """Settings of NAFNet and its training; the default size is that of Yang et al. 2024, section 5.3."""

    width: Annotated[Whole, Field(gt=0, le=4096)] = Field(
        32, description="Channels at full resolution; each encoder level doubles them."
    )
    encoder: tuple[Small, ...] = Field((1, 1, 1, 8), max_length=8, description="Blocks of each encoder level.")
    middle: Small = Field(1, description="Blocks between encoder and decoder.")
    decoder: tuple[Small, ...] = Field((1, 1, 1, 1), max_length=8, description="Blocks of each decoder level.")
    steps: Steps = Field(description="Number of steps.")
    check: Steps = Field(500, description="Steps between validations on the minival.")
    batch_size: Batch = Field(32, description="Captures per step.")
    crop: Annotated[Whole, Field(gt=0, le=8192)] | None = Field(
        None, description="Side of the crops of captures in training [pixels]; null: whole captures."
    )
    learning_rate: LearningRate = Field(
        1e-3, description="Largest learning rate of AdamW, after a warm-up; it falls along a cosine to zero."
    )

    @model_validator(mode="after")
    def _symmetric(self) -> "RestorationSettings":
        if len(self.encoder) != len(self.decoder):
            raise ValueError("`encoder` and `decoder` need the same number of levels")
        if self.crop is not None and self.crop % self.multiple:
            levels = len(self.encoder)
            raise ValueError(f"crop = {self.crop}: expected a multiple of {self.multiple} for {levels} levels")
        return self

    @property
    def multiple(self) -> int:
        """Number that image sides must be multiples of: each encoder level halves them."""
        return 2 ** len(self.encoder)
