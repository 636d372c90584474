"""Settings of designs by least squares; no torch here."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from tasklens.settings.base import Angle, Count, Name, Positive, Steps, WithoutDescents


class LeastSquaresSettings(WithoutDescents):
    """Settings of damped least squares on ray residuals, from many random paraxial starts."""

    method: Literal["least_squares"]
    starts: Annotated[Count, Field(le=10**6)] = Field(150, description="Number of random paraxial starts.")
    evaluations: Steps = Field(8000, description="Budget of evaluations of all residuals, with or without derivatives.")
    reference: Literal["centroid", "chief_ray"] = Field("centroid", description="Reference point of spots.")
    highest_order: Literal[4, 6, 8, 10] = Field(10, description="Highest order of the variable asphere coefficients.")
    corner_weight: Positive = Field(1.0, description="Weight of the corner field; geometric series from 1 on axis.")
    max_chief_ray_angle_deg: Angle | None = Field(
        None, description="Largest chief ray angle on the sensor [degrees]; null: no limit."
    )
    vignetting: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None,
        description="Largest fraction of the light of a field that the clear aperture of one surface may stop to make "
        "the spot smaller; on the axis it stops none. Null: no light is stopped.",
    )
    spot_um: Positive | dict[Name, Positive] | None = Field(
        None,
        description="RMS spot radius at which the search ends [um], one value or one by name of elements, for a lens "
        "as sharp as another, such as one of the paper's; null: the whole budget.",
    )

    @model_validator(mode="after")
    def _check_vignetting(self) -> "LeastSquaresSettings":
        if self.spot_um is not None and self.vignetting is not None:
            raise ValueError("spot_um: not with `vignetting`, which only a whole search reaches")
        return self

    def of_elements(self, elements: str) -> "LeastSquaresSettings":
        """Return the settings for some elements, with one `spot_um`."""
        if not isinstance(self.spot_um, dict):
            return self
        return self.model_copy(update={"spot_um": self.spot_um.get(elements)})
