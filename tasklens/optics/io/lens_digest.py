"""Digest of the prescription in a lens file, stored with its figures; this module does not import torch."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tasklens.runtime.files import damage_error

KEY = "digest"


def digest(content: Mapping[str, Any]) -> str:
    """Return the digest of materials, stop and surfaces."""
    text = json.dumps([content[key] for key in ("materials", "stop", "surfaces")], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_changed(content: Mapping[str, Any]) -> bool:
    """Return whether the prescription was changed after its figures were computed."""
    return KEY in content and content[KEY] != digest(content)


def check(content: Mapping[str, Any], path: Path) -> None:
    """Raise FileError if the prescription was changed after its figures were computed."""
    if is_changed(content):
        raise damage_error(path, "its prescription was changed after its figures were computed")
