"""Settings of image restoration; no torch here."""

from typing import Annotated

from pydantic import Field, model_validator

from tasklens.settings.frozen import Frozen
from tasklens.settings.quantities import Batch, LearningRate, Small, Steps, Whole


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
