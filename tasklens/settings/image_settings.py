"""Settings of labelled images; no torch here."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from tasklens.settings.base import Count, Frozen, Periods, Seed, Whole

RENDERED_CLASSES = 10  # a copy of len(scenes.CLASSES), whose module imports torch


class ImageSettings(Frozen):
    """Settings of labelled images: rendered, or read from `folder`: train/<class>/* and test/<class>/* (or val).

    A folder with only <class>/* is split into test, minival and training images.
    """

    size: Whole = Field(64, ge=16, le=8192, description="Side of the square images [pixels].")
    train: Count | None = Field(None, description="Number of training images; for a folder the maximum, null: all.")
    minival: Annotated[Count, Field(ge=2)] = Field(  # errors are computed from them
        500, description="Number of validation images, held out from training."
    )
    test: Count | None = Field(None, description="Number of test images; for a folder the maximum, null: all.")
    seed: Seed = Field(0, description="Seed of the rendering, or of the choice and split of a folder's images.")
    folder: Path | None = Field(None, description="Folder of photographs; null: rendered textures.")
    periods: Periods = Field(
        (5.0, 16.0), description="Shortest and longest period of rendered textures [pixels]; shorter ones are harder."
    )

    @model_validator(mode="after")
    def _rendered_need_counts(self) -> "ImageSettings":
        if self.folder is not None:
            return self
        if self.train is None or self.test is None:
            raise ValueError("rendered images need the counts `train` and `test`")
        if (count := self.train + self.minival + self.test) * 3 * self.size**2 > 1e12:
            raise ValueError(
                f"expected rendered images of at most 1 TB, got {count} of {self.size} x {self.size} pixels"
            )
        if min(self.train + self.minival, self.test) < RENDERED_CLASSES:
            raise ValueError(f"expected at least {RENDERED_CLASSES} rendered images of each split, one per class")
        return self
