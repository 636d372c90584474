"""Names under which classifiers are measured."""

SHARP = "sharp"  # stands where a lens name stands, for a classifier that takes the sharp images themselves
_RESTORED = "-restored"


def restored(classifier: str) -> str:
    """Name of a classifier on restored captures."""
    return f"{classifier}{_RESTORED}"


def split(measured_name: str) -> tuple[str, bool]:
    """The classifier that is measured under a name, and whether on restored captures."""
    return measured_name.removesuffix(_RESTORED), measured_name.endswith(_RESTORED)
