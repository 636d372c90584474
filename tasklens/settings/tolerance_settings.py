"""Settings of tolerances: tolerance grades, and lenses built in simulation; no torch here."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from tasklens.settings.base import Count, Frozen

Tolerance = Annotated[float, Field(ge=0, le=1000)]
Percent = Annotated[float, Field(ge=0, le=50)]

# Moulding: the columns "injection molding" of apollooptical.com/manufacturing-tolerances for radius, thickness (used
# for air spaces too), concentricity (decentre of the surfaces of an element) and irregularity. Makers of phone lenses
# publish no tolerances, and their moulds are diamond-turned, so `phone_moulding` has that page's column "single point
# diamond turning, precision". The decentre of an element in its barrel is half of that page's tolerance of the
# diameter. Tilts are our choice: the tolerance of the thickness across 5 mm of flange. Index and dispersion:
# OpticStudio's default tolerances, 0.001 and 1 %; half of them for precise moulding, our choice.
_GRADES = ("commercial_moulding", "precision_moulding", "phone_moulding")
_TOLERANCES = {  # in the order of `_GRADES`
    "radius_percent": (1.0, 0.5, 0.1),
    "irregularity_fringes": (6.0, 3.0, 2.0),
    "thickness_um": (25.0, 15.0, 5.0),
    "air_space_um": (25.0, 15.0, 5.0),
    "index": (0.001, 0.0005, 0.0005),
    "dispersion_percent": (1.0, 0.5, 0.5),
    "surface_decentre_um": (25.0, 15.0, 2.0),
    "surface_tilt_mrad": (5.0, 3.0, 1.0),
    "element_decentre_um": (25.0, 12.5, 2.5),
    "element_tilt_mrad": (5.0, 3.0, 1.0),
}
GRADES = {grade: {key: row[k] for key, row in _TOLERANCES.items()} for k, grade in enumerate(_GRADES)}


class Grade(Frozen):
    """Tolerance grade: the largest errors, of either sign; a study may also name one of `GRADES`.

    Errors are independent, and normal with half of the tolerance as standard deviation, cut at the tolerance.
    """

    name: str = Field("custom", description="Name in tables.")
    radius_percent: Percent = Field(description="Radius of curvature [%].")
    irregularity_fringes: Tolerance = Field(
        description="Form error, peak to valley, symmetric about the axis [fringes of 0.6328 um over a diameter of 25 "
        "mm; proportionally less over the clear aperture]."
    )
    thickness_um: Tolerance = Field(description="Centre thickness of an element [um].")
    air_space_um: Tolerance = Field(description="Air space in front of an element [um].")
    index: Annotated[float, Field(ge=0, le=0.1)] = Field(description="Refractive index at the reference wavelength.")
    dispersion_percent: Percent = Field(description="Dispersion, the inverse of Abbe's number [%].")
    surface_decentre_um: Tolerance = Field(
        description="Decentre of each further surface of an element from its first, along x and along y [um]."
    )
    surface_tilt_mrad: Tolerance = Field(
        description="Tilt of each further surface of an element from its first, about x and about y [mrad]."
    )
    element_decentre_um: Tolerance = Field(description="Decentre of an element in its barrel, along x and y [um].")
    element_tilt_mrad: Tolerance = Field(description="Tilt of an element, about x and about y [mrad].")

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in GRADES:
            raise ValueError(f"expected tolerances, or one of {', '.join(GRADES)}")
        return GRADES[value] | {"name": value}

    @model_validator(mode="after")
    def _something_varies(self) -> "Grade":
        if not any(self.model_dump(exclude={"name"}).values()):
            raise ValueError("expected a tolerance above zero")
        return self


class ToleranceSettings(Frozen):
    """Settings of lenses that are built in simulation with manufacturing errors, focused, and measured."""

    grade: Grade = Field(
        Grade.model_validate("precision_moulding"), description="Tolerance grade: its name, or its tolerances."
    )
    lenses: Annotated[Count, Field(ge=10, le=10**6)] = Field(200, description="Number of lenses built per design.")
    images: Annotated[Count, Field(ge=10)] = Field(
        100,
        description="Number of test images that measure a built lens, each at one field of every cell of the grading.",
    )
    designs: tuple[str, ...] | None = Field(
        None,
        description="Designs, imported lenses, or single lenses such as doublet-tasklens, to build; null: all of "
        "table 1.",
    )
