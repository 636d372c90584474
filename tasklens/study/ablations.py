"""Ablations: a design compared with variants of itself; no torch here."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from tasklens.settings.base import Frozen, Name
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DesignSettings
from tasklens.settings.field_settings import FieldSet
from tasklens.settings.layers import merged_settings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import LensEntry

_DESIGN = TypeAdapter(DesignSettings)


class Ablation(Frozen):
    """Variants of one design of one set of elements.

    Attributes:
        elements, design: names of the elements and of the design.
        variants: by name, the keys of the design that differ; `capture` holds keys of the study's capture that differ
            both in the design and in the measurement of the variant, and `fields` the fields of its losses.
    """

    elements: Name
    design: Name
    variants: Annotated[dict[Name, dict[str, Any]], Field(min_length=1)]

    def name(self, ablation: str, variant: str) -> str:
        """Return the design name of a variant."""
        return f"{self.design}_{ablation}_{variant}"


def variant_entry(base: LensEntry, capture: CaptureSettings, name: str, ablation: Ablation, variant: str) -> LensEntry:
    """Return the entry of a variant of the lens `base`.

    Args:
        capture: capture settings of the study.
        name: name of the ablation.

    Raises:
        ValueError: invalid changes (pydantic's ValidationError), a `capture` that is no mapping, or a sensor without a
            choice of `colour`.
    """
    changes = dict(ablation.variants[variant])
    other, fields = changes.pop("capture", None), changes.pop("fields", None)
    if not isinstance(other, dict | None):
        raise ValueError(f"ablations.{name}.variants.{variant}.capture: expected keys and values, got {other!r}")
    if other is not None:
        capture.check_new_sensor(other, f"ablations.{name}.variants.{variant}.capture")
    design_name = ablation.name(name, variant)
    design = _DESIGN.validate_python(merged_settings(base.design.model_dump(), changes))
    if isinstance(design, LeastSquaresSettings):
        design = design.of_elements(base.elements)
    return LensEntry(
        name=f"{base.elements}-{design_name}",
        elements=base.elements,
        plastics=base.plastics,
        design_name=design_name,
        design=design,
        capture=None if other is None else CaptureSettings.model_validate(merged_settings(capture.model_dump(), other)),
        fields=fields,
    )


def check_differences(
    entries: Mapping[str, LensEntry], base: Any, capture: CaptureSettings, fields: FieldSet, where: str
) -> None:
    """Check that variants differ from the design and from each other.

    Args:
        entries: lenses of the variants, by name.
        base, capture, fields: settings of the unchanged design, its captures, and the fields of its losses.

    Raises:
        ValueError: a variant changes nothing, or equals another one; the message begins with `where`.
    """
    seen = [((base, capture, fields), "the design itself")]
    for name, entry in entries.items():
        values = entry.design, entry.capture or capture, entry.fields or fields
        if same := [words for other, words in seen if other == values]:
            raise ValueError(f"{where}.{name}: has the same values as {same[0]}; change one, or remove it")
        seen.append((values, f"the variant {name}"))
