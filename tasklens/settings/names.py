"""Names of splits, of what sets a focus, and of measurements: classifiers with or without restoration, sharp images."""

from typing import Literal

Focus = Literal["file", "network", "mtf", "spot"]  # what sets the image plane of a lens from a file
SPLITS = ("train", "minival", "test")  # of the images
SHARP = "sharp"  # used in place of a lens name for measurements on the sharp images
_RESTORED = "-restored"


def measured_name(name: str, on_restored: bool) -> str:
    """Return the measured name of a classifier, or of the captures of a lens, restored or not."""
    return f"{name}{_RESTORED}" if on_restored else name


def split(measured_name: str) -> tuple[str, bool]:
    """Split a measured name into the classifier, and whether captures are restored."""
    return measured_name.removesuffix(_RESTORED), measured_name.endswith(_RESTORED)
