"""Input files of the page of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PageFiles:
    """Files of a page, by name of a table or figure, or by lens.

    Attributes:
        by_seed: rows of the tables by seed.
        optional_names: names of all optional tables.
        optional, drawn: optional tables and figures that exist.
        pictures: drawings by name (section, spots, psfs, curves) and lens.
    """

    tables: Mapping[str, Path]
    by_seed: Mapping[str, Path]
    others: Mapping[str, Path]
    optional_names: Sequence[str]
    optional: Mapping[str, Path]
    drawn: Mapping[str, Path]
    provenance: Sequence[Path]
    lenses: Mapping[str, Path]
    histories: Mapping[str, Path]
    pages: Mapping[str, Path]
    zemax: Mapping[str, Path]
    catalogues: Mapping[str, Path]
    pictures: Mapping[str, Mapping[str, Path]]
    restorations: Mapping[str, Path]
    captures: Path
    answers: Path
    benchmarks: Path
