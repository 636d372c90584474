"""Learning rates of a lens; no torch here."""

from typing import Any

from pydantic import Field, model_validator

from tasklens.settings.frozen import Frozen
from tasklens.settings.quantities import Fraction, LearningRate

PRESETS = {  # those of the paper (section 3.3), and ours for 500 steps from flat plates
    "paper": {"curvature": 1e-4, "thickness": 1e-4, "alpha_4": 1e-4, "decay": 0.02, "normalised": False},
    "ours": {"curvature": 4e-3, "thickness": 2e-3, "alpha_4": 4e-3, "decay": 0.5},
}


class LearningRates(Frozen):
    """Learning rates of AdamW for the lens; a study may also name one of `PRESETS`."""

    curvature: LearningRate = Field(1e-4, description="Learning rate of curvatures [1/mm].")
    thickness: LearningRate = Field(1e-4, description="Learning rate of thicknesses [mm].")
    alpha_4: LearningRate = Field(1e-4, description="Learning rate of alpha_4, in the units of `normalised`.")
    decay: Fraction = Field(0.02, description="Ratio of learning rates of successive asphere orders (paper 3.3).")
    normalised: bool = Field(
        True,
        description="Optimise alpha_k R^(k - 1), with R the illuminated radius on the surface of the start [mm]; "
        "false: alpha_k itself, as in the paper.",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in PRESETS:
            raise ValueError(f"expected learning rates, or one of {', '.join(PRESETS)}")
        return PRESETS[value]
