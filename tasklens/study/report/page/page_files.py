"""Input files of the page of a study."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PageFiles:
    """Input files as the rule names them.

    Attributes:
        table_files, seeds_files, provenance: tables, their rows by seed, and facts about the machine.
        lenses, histories, pages, zemax, catalogues, sections, spots, psfs, curves: files of each lens.
        restorations: histories of the restoration networks.
        optional, drawn: tables and figures that are shown if they exist.
        benchmarks: folder of Snakemake's benchmarks.
    """

    table_files: Sequence[Path]
    seeds_files: Sequence[Path]
    provenance: Sequence[Path]
    verdicts: Path
    psf_tail: Path
    effort: Path
    lenses: Sequence[Path]
    histories: Sequence[Path]
    pages: Sequence[Path]
    zemax: Sequence[Path]
    catalogues: Sequence[Path]
    sections: Sequence[Path]
    spots: Sequence[Path]
    psfs: Sequence[Path]
    curves: Sequence[Path]
    restorations: Sequence[Path]
    capture_file: Path
    answers: Path
    optional: Sequence[Path]
    drawn: Sequence[Path]
    benchmarks: Path


def table_name(table: Path) -> str:
    """Return the name of a table from that of its file."""
    return table.stem.replace(".", "_")
