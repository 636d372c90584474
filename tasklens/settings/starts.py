"""Designs that others start from, by their names; no torch here."""

from collections.abc import Iterable, Mapping

from tasklens.settings.base import WithoutDescents
from tasklens.settings.design_settings import DesignSettings, GradientDesignSettings

DesignsByName = Mapping[str, DesignSettings]


def imaging_designs(designs: DesignsByName) -> tuple[str, ...]:
    """Return the imaging designs: those without a network."""
    return tuple(name for name, design in designs.items() if not design.by_network)


def vignetted_designs(designs: DesignsByName) -> tuple[str, ...]:
    """Return the designs whose apertures stop light; no other design starts from them."""
    return tuple(name for name, design in designs.items() if getattr(design, "vignetting", None) is not None)


def best_of(designs: DesignsByName) -> dict[str, tuple[str, ...]]:
    """Return the designs of which the most accurate is the start, by the keyword of `start`."""
    imaging = [name for name in imaging_designs(designs) if name not in vignetted_designs(designs)]
    spots = (name for name in imaging if all(descent.criterion == "spot" for descent in designs[name].descents))
    return {"best_imaging": tuple(imaging), "best_spot": tuple(spots)}


def starting_designs(design: DesignSettings | WithoutDescents, designs: DesignsByName) -> tuple[str, ...]:
    """Return the designs that a design may start from, also those that `best_imaging` or `best_spot` may choose."""
    return best_of(designs).get(str(design.start), design.starting_designs)


def check(
    where: str, name: str, design: GradientDesignSettings, designs: DesignsByName, imported: Iterable[str] = ()
) -> None:
    """Check that there is a start for a design, and that it may begin there; raises ValueError.

    Args:
        where: key of the design.
        imported: lenses from files that it may start from.
    """
    if best_of(designs).get(str(design.start)) == ():
        quality = " or image quality" * (design.start == "best_imaging")
        raise ValueError(f"{where}.start: {design.start!r} needs a design by spot or least squares{quality}")
    choices = [*imported, *(designs if design.by_network else imaging_designs(designs))]
    choices = [choice for choice in choices if choice not in (name, *vignetted_designs(designs))]
    for start in design.starting_designs:
        if start not in choices:
            raise ValueError(
                f"{where}.start: {start!r} cannot be the start of this design; expected one of {', '.join(choices)}"
            )
