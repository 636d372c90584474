"""Base class of all settings; no torch here."""

from pydantic import BaseModel, ConfigDict


class Frozen(BaseModel):
    """Base class of all settings: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")
