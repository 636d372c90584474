"""The designs that have a name: methods of `tasklens design`, and their schedules from flat plates; no torch here."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

_PHOTOGRAPHS = 128  # least side of images that are taken for photographs [pixels]


@cache
def methods() -> dict[str, dict[str, Any]]:
    """Return the settings of a design by each method."""
    return _read("designs.yaml")


def from_flat(side: int) -> dict[str, Any]:
    """Return the settings of a design by the task from flat plates, as in the studies of such images.

    Args:
        side: side of the images [pixels].
    """
    return _read("from_flat.yaml")["photographs" if side >= _PHOTOGRAPHS else "textures"]


@cache
def _read(name: str) -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name(name).read_text(encoding="utf-8"))


def with_named_designs(config: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the names of methods in the section `designs` of a study by their settings."""
    designs = config.get("designs")
    if not isinstance(designs, Mapping):
        return dict(config)
    named = {key: methods().get(value, value) if isinstance(value, str) else value for key, value in designs.items()}
    return {**config, "designs": named}
