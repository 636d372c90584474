"""Ablations: a design of the study beside variants of itself, each changed in one thing; no torch here."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from tasklens.design_settings import Design
from tasklens.settings import Frozen, Name

_DESIGN = TypeAdapter(Design)


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


def varied(design: Design, changes: Mapping[str, Any]) -> Design:
    """The design with `changes` in it; raises ValidationError where they do not fit."""
    return _DESIGN.validate_python(_merged(design.model_dump(), changes))


def _merged(base: Any, changes: Any) -> Any:
    """Mappings merged key by key, at any depth; what is no mapping replaces what was there."""
    if not (isinstance(base, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**base, **{key: _merged(base.get(key), value) for key, value in changes.items()}}
