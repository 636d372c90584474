"""Reference data of the tests: files of tests/data, and more of the same in ../shared where a developer has it."""

from pathlib import Path

SHIPPED = Path(__file__).parent / "data"
SHARED = Path(__file__).parents[2] / "shared"  # larger, and in part under licences that do not let us distribute it


def reference_files(pattern: str) -> list[Path]:
    """Files that match, by name; of one that is in both places that of ../shared, of which ours may be a part."""
    found = {path.relative_to(root): path for root in (SHIPPED, SHARED / "data") for path in root.glob(pattern)}
    return [found[name] for name in sorted(found)]


def original_of(path: Path) -> Path:
    """Return the path in ../shared of a file of tests/data."""
    name = path.relative_to(SHIPPED)
    return SHARED / name if name.parts[0] == "reference" else SHARED / "data" / name
