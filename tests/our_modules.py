"""Modules of our packages and their names."""

from pathlib import Path

from tasklens.study.run import digest

ROOT = Path(__file__).parents[1]
MODULES = sorted(p for package in digest.PACKAGES for p in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
