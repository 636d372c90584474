"""Rendering or reading of the images with objects."""

import sys

from tasklens.recognition import object_splits, objects
from tasklens.runtime.files import Files
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write both splits."""
    for name, split in object_splits.make(settings.scenes).items():
        objects.write(split, getattr(outputs, name), getattr(outputs, f"{name}_objects"))
        print(f"{name}: {len(split)} images with {len(split.owner)} objects", file=sys.stderr)
