"""Ablations: a design of the study beside variants of itself, each changed in one thing; no torch here."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from tasklens.study.design_settings import DesignSettings, LensEntry
from tasklens.study.settings import CaptureSettings, Frozen, Name

_DESIGN = TypeAdapter(DesignSettings)


class Ablation(Frozen):
    """Which design of which elements is varied, and how.

    Attributes:
        variants: by name, the keys of the design that differ; `capture` holds those of the study's capture, with which
            the variant is then designed and measured.
    """

    elements: Name
    design: Name
    variants: Annotated[dict[Name, dict[str, Any]], Field(min_length=1)]

    def name(self, ablation: str, variant: str) -> str:
        """Name of the design that a variant is."""
        return f"{self.design}_{ablation}_{variant}"


def variant_entry(base: LensEntry, capture: CaptureSettings, name: str, ablation: Ablation, variant: str) -> LensEntry:
    """The lens that a variant of the ablation `name` makes of the lens `base`, in a study that captures by `capture`.

    Raises:
        ValueError: changes that do not fit (pydantic's ValidationError), or a capture without keys.
    """
    changes = dict(ablation.variants[variant])
    other = changes.pop("capture", None)
    if not isinstance(other, dict | None):
        raise ValueError(f"ablations.{name}.variants.{variant}.capture: expected keys and values, got {other!r}")
    design_name = ablation.name(name, variant)
    return LensEntry(
        name=f"{base.elements}-{design_name}",
        elements=base.elements,
        plastics=base.plastics,
        design_name=design_name,
        design=_DESIGN.validate_python(_merged(base.design.model_dump(), changes)),
        capture=None if other is None else CaptureSettings.model_validate(capture.model_dump() | other),
    )


def _merged(base: Any, changes: Any) -> Any:
    """Mappings merged key by key, at any depth; what is no mapping replaces what was there."""
    if not (isinstance(base, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**base, **{key: _merged(base.get(key), value) for key, value in changes.items()}}
