"""Specification and limits of a lens; no torch here."""

import math

from pydantic import Field, computed_field, field_validator

from tasklens.fields import PAPER
from tasklens.settings.base import Angle, Fraction, Frozen, Length, Micrometres, Small, Whole


class Spec(Frozen):
    """Specification of lenses; the defaults are those of Yang et al. 2024, sections 3.3 and 4."""

    diagonal_mm: Length = Field(4.0, description="Diagonal of the sensor [mm].")
    aspect: tuple[Small, Small] = Field((16, 9), description="Width to height of the sensor.")
    field_of_view_deg: float = Field(68.8, ge=0.1, lt=150, description="Full field of view on the diagonal [degrees].")
    f_number: float = Field(  # at 0.5 the marginal ray of a lens free of coma is at right angles to the axis
        2.8, ge=0.5, le=100, description="Focal length over diameter of the entrance pupil."
    )
    pixel_pitch_um: Micrometres = Field(1.8, description="Pixel pitch [um].")
    kernel_size: Whole = Field(51, ge=3, description="Width of the square PSF window [pixels], odd.")
    wavelengths_um: tuple[Micrometres, Micrometres, Micrometres] = Field(
        (0.6563, 0.5893, 0.4861),
        description="Red, green and blue [um]; the middle one is the reference. C, D, F lines.",
    )
    object_distance_mm: float | None = Field(
        None,
        ge=1,
        le=1e9,
        description="Distance of the object from the first vertex [mm], for imported lenses; null: infinity.",
    )

    @field_validator("wavelengths_um")
    @classmethod
    def _descending(cls, wavelengths: tuple[float, float, float]) -> tuple[float, float, float]:
        if not wavelengths[0] > wavelengths[1] > wavelengths[2]:
            raise ValueError("expected red, green, blue: descending wavelengths")
        return wavelengths

    @field_validator("kernel_size")
    @classmethod
    def _odd(cls, kernel_size: int) -> int:
        if kernel_size % 2 == 0:
            raise ValueError("expected an odd number, so that the PSF has a central pixel")
        return kernel_size

    @computed_field
    @property
    def efl_mm(self) -> float:
        """Focal length [mm] that puts the field of view on the diagonal: (d / 2) / tan(FoV / 2)."""
        return self.diagonal_mm / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)

    @computed_field
    @property
    def stop_radius_mm(self) -> float:
        """Radius [mm] of the stop, which is in front of the lens: EFL / (2 F)."""
        return self.efl_mm / (2 * self.f_number)

    @computed_field
    @property
    def fields_mm(self) -> tuple[tuple[float, float], ...]:
        """Nine fields f tan(theta) [mm]: {0, 1/2, 1} x {0, 1/2, 1} of the half width and half height of the sensor."""
        unit = self.diagonal_mm / 2 / math.hypot(*self.aspect)
        width, height = (unit * side for side in self.aspect)
        return tuple((u * width, v * height) for u, v in PAPER)


class Constraints(Frozen):
    """Limits of a design [mm; slope is d sag / d r], for moulded plastic elements in a phone.

    They are our choice: the paper states none.
    """

    min_centre_thickness: Length = Field(0.25, description="Least centre thickness of an element [mm].")
    max_centre_thickness: Length = Field(1.5, description="Largest centre thickness of an element [mm].")
    min_edge_thickness: Length = Field(0.2, description="Least thickness of an element within its aperture [mm].")
    min_air_gap: Length = Field(0.05, description="Least air space between elements within their apertures [mm].")
    min_back_focus: Length = Field(0.7, description="Least distance from the last surface to the sensor [mm].")
    max_track: Length = Field(4.4, description="Largest distance from the first surface to the sensor [mm].")
    max_slope: float = Field(0.57, gt=0, le=100, description="Largest slope d sag / d r of a surface.")
    stop_distance: Length = Field(0.1, description="Distance from the stop to the first surface [mm].")
    flat_track: float = Field(
        1.3, gt=0, le=100, description="Distance from the stop to the sensor of a flat start [focal lengths]."
    )
    efl_tolerance: Fraction = Field(0.02, description="Largest deviation of the focal length, as a fraction.")
    distortion: Fraction = Field(
        0.03, description="Largest distortion, a fraction of the image height at the specified focal length."
    )
    max_chief_ray_angle_deg: Angle | None = Field(
        None, description="Largest chief ray angle on the sensor [degrees]; null: no limit, as in the paper."
    )
