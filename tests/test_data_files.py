"""The files of tests/data: small, and each with its source."""

from reference_files import SHIPPED

FILES = sorted(path for path in SHIPPED.rglob("*") if path.is_file())
SOURCES = SHIPPED / "SOURCES.md"


def test_every_file_has_a_source():
    text = SOURCES.read_text()
    assert [path.name for path in FILES if path != SOURCES and f"{path.name}`" not in text] == []


def test_they_stay_small():
    assert sum(path.stat().st_size for path in FILES) < 600_000
