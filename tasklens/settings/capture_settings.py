"""Settings of captures and sensors; no torch here."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from tasklens.runtime.errors import InputError
from tasklens.settings.base import Frozen, Magnification, Whole


class SensorSettings(Frozen):
    """Settings of a sensor's noise and levels; the defaults are our choice, typical of a phone in daylight."""

    full_well: float = Field(6000, ge=1, le=1e9, description="Electrons per pixel at white with gain 1.")
    gain: Magnification = Field(1, description="Gain: white is at full_well / gain electrons; about 16 indoors.")
    read_noise: float = Field(2, ge=0, le=1e6, description="Standard deviation of the read noise [electrons].")
    bits: Annotated[Whole, Field(ge=1, le=16)] = Field(8, description="Bits of the sRGB values.")


class CaptureSettings(Frozen):
    """Settings of captures: light outside the PSF window, colour values that are convolved, diffraction, the sensor."""

    outside_window: Literal["veil", "renormalise"] = Field(
        "veil",
        description="Light outside the PSF window. veil: a uniform veil that conserves the mean; renormalise: removed "
        "by renormalising the PSF, as in the authors' code.",
    )
    colour: Literal["srgb", "linear"] = Field(
        "srgb",
        description="srgb: convolution of sRGB values, our reading of the paper; linear: of linear light, as in a "
        "camera, the default with a `sensor`.",
    )
    sensor: SensorSettings | None = Field(
        None,
        description="Shot noise, read noise and rounding, at the lens' relative illumination, which is corrected "
        "afterwards; in design, training and measurement; null: none.",
    )
    diffraction: bool = Field(
        False, description="Include diffraction in the PSFs of training and measurement; designs are geometric."
    )

    def check_new_sensor(self, changes: Mapping[str, Any], where: str) -> None:
        """Check that changes which add a sensor say what is blurred, unless these settings do; raises InputError.

        The default of `colour` depends on the sensor, and has already been applied.
        """
        adds = self.sensor is None and changes.get("sensor") is not None
        if adds and "colour" not in changes and "colour" not in self.model_fields_set:
            raise InputError(f"{where}: adds a sensor; also give `colour`, linear as in a camera, or srgb")

    @model_validator(mode="before")
    @classmethod
    def _default_colour(cls, values: Any) -> Any:
        """Take linear light by default with a sensor: its noise is that of light."""
        if isinstance(values, dict) and values.get("sensor") is not None and "colour" not in values:
            return values | {"colour": "linear"}
        return values
