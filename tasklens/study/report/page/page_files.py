"""Input files of the page of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tasklens.study.report_jobs import ReportJob


@dataclass(frozen=True)
class RuleFiles:
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

    @classmethod
    def of(cls, settings: ReportJob, files: RuleFiles) -> "PageFiles":
        """Return the files by the names in the settings."""

        def by_lens(paths: Sequence[Path]) -> dict[str, Path]:
            return dict(zip(settings.elements, paths, strict=True))

        pictures = {"section": files.sections, "spots": files.spots, "psfs": files.psfs, "curves": files.curves}
        return cls(
            tables=dict(zip(settings.tables, files.table_files, strict=True)),
            by_seed=dict(zip(settings.tables, files.seeds_files, strict=True)),
            others={"verdicts": files.verdicts, "psf_tail": files.psf_tail, "effort": files.effort},
            optional_names=[table_name(path) for path in files.optional],
            optional={table_name(path): path for path in files.optional if path.exists()},
            drawn={path.stem: path for path in files.drawn if path.exists()},
            provenance=files.provenance,
            lenses=by_lens(files.lenses),
            histories=by_lens(files.histories),
            pages=by_lens(files.pages),
            zemax=by_lens(files.zemax),
            catalogues=by_lens(files.catalogues),
            pictures={name: by_lens(paths) for name, paths in pictures.items()},
            restorations=dict(zip(settings.restored, files.restorations, strict=True)),
            captures=files.capture_file,
            answers=files.answers,
            benchmarks=files.benchmarks,
        )


def table_name(table: Path) -> str:
    """Return the name of a table from that of its file."""
    return table.stem.replace(".", "_")
