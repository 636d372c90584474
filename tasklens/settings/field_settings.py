"""Fields of a study: points of the sensor that designs see, and points at which lenses are graded; no torch here.

Points are fractions of the half width and half height of the sensor, as in `tasklens.fields`.
"""

from math import hypot
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from tasklens.fields import CORNER, GRADING, GRADING_CENTRES, PAPER, SELECTION, Points
from tasklens.settings.base import Frozen

NAMED = ("sensor", "paper")  # sets that have a name
_LEAST = 4  # fields of a set
_MISSED = 0.1  # largest distance of the nearest field of a set from axis and corner [diagonals]


def _check_set(value: Any) -> Any:
    """Check a set of fields: a word, or a list of [x, y] from 0 to 1."""
    if isinstance(value, str) and value in NAMED:
        return value
    if not isinstance(value, list | tuple) or not all(_is_point(point) for point in value):
        raise ValueError(
            f"expected {' or '.join(NAMED)}, or a list of [x, y], fractions of the half width and half height"
        )
    if len(value) < _LEAST:
        raise ValueError(f"expected at least {_LEAST} fields, found {len(value)}")
    return tuple((float(u), float(v)) for u, v in value)


def _is_point(point: Any) -> bool:
    return (
        isinstance(point, list | tuple)
        and len(point) == 2
        and all(isinstance(part, int | float) and not isinstance(part, bool) and 0 <= part <= 1 for part in point)
    )


FieldSet = Annotated[str | Points, BeforeValidator(_check_set)]


class FieldSettings(Frozen):
    """Settings of the fields of a study; `paper` or `sensor` alone stands for both keys."""

    design: FieldSet = Field(
        "sensor",
        description="Fields of the losses of designs. sensor: drawn anew in each step, uniformly in area, one in each "
        "of 3 x 3 cells; paper: the paper's nine in every step; or a list of [x, y], fractions of the half width and "
        "half height of the sensor.",
    )
    grading: FieldSet = Field(
        "sensor",
        description="Fields of the test images, which no design or choice uses. sensor: one in each of 4 x 4 cells, "
        "the centre of another quarter of the cell for each of four images; paper: the paper's nine, on which networks "
        "are then trained and lenses chosen, too; or a list.",
    )
    nine: bool = Field(False, description="Grade lenses at the paper's nine fields, too.")

    @model_validator(mode="before")
    @classmethod
    def _one_word(cls, value: Any) -> Any:
        return dict.fromkeys(("design", "grading"), _check_set(value)) if isinstance(value, str) else value

    @property
    def design_points(self) -> Points | None:
        """Fields of the losses of designs; None if they are drawn."""
        return points(self.design)

    @property
    def grading_points(self) -> Points:
        """Fields of the test images, or the centres of their cells."""
        return points(self.grading) or GRADING_CENTRES

    @property
    def graded_points(self) -> tuple[Points, ...]:
        """Fields that the test images take in turns: image i those with the number i modulo the number of turns."""
        return GRADING if self.grading == "sensor" else (self.grading_points,)

    @property
    def halfway(self) -> int:
        """Index of the field of the grading that is nearest to the middle of the quadrant."""
        fields = self.grading_points
        return min(range(len(fields)), key=lambda k: hypot(fields[k][0] - 0.5, fields[k][1] - 0.5))

    def sets(self, design: Points | None) -> dict[str, tuple[Points, ...] | None]:
        """Return the sets of fields at which the PSFs of a lens are needed, by turns; None: drawn uniformly in area.

        Args:
            design: fields of the losses of its design.
        """
        sets: dict[str, tuple[Points, ...] | None] = {
            "training": None,
            "selection": SELECTION,
            "grading": self.graded_points,
            "nine": (PAPER,),
            "corner": (CORNER,),
        }
        if self.grading == "paper":
            return sets | {"training": (PAPER,), "selection": (PAPER,)}
        return sets if design is None or design == PAPER else sets | {"design": (design,)}

    def grading_sets(self, design: Points | None) -> dict[str, str]:
        """Return the sets of fields at which a lens is graded, by metric; `design` as in `sets`."""
        graded = {"accuracy": "grading", "corner_accuracy": "corner"}
        if self.grading == "paper":
            return graded
        if design is not None:
            graded["accuracy_at_design_fields"] = "nine" if design == PAPER else "design"
        return graded | ({"accuracy_at_nine": "nine"} if self.nine else {})


def radii(fields: Points, aspect: tuple[float, float]) -> tuple[float, ...]:
    """Return the distances of fields from the axis, in units of that of the corner.

    Args:
        aspect: width and height of the sensor.
    """
    return tuple(hypot(u * aspect[0], v * aspect[1]) / hypot(*aspect) for u, v in fields)


def check_set(fields: Points, aspect: tuple[float, float], where: str) -> None:
    """Check that a set reaches from the axis to the corner; raises ValueError."""
    distances = radii(fields, aspect)
    for name, missed in (("axis", min(distances) / 2), ("corner", (1 - max(distances)) / 2)):
        if missed > _MISSED:
            raise ValueError(
                f"{where}: the set misses the {name} by {missed:.2f} of the diagonal; expected at most {_MISSED}"
            )


def check_unseen(grading: Points, used: Points, where: str) -> None:
    """Check that no field of the grading is one of those used `where`; raises ValueError."""
    if seen := {*grading} & {*used}:
        raise ValueError(
            f"fields.grading: {list(min(seen))} is also a field of {where}; expected fields that nothing was chosen on"
        )


def points(fields: FieldSet) -> Points | None:
    """Return the points of a set; None for the whole sensor."""
    if fields == "sensor":
        return None
    return PAPER if isinstance(fields, str) else fields
