"""Export of a study to one file for a colleague: configuration, tables, lenses, measurements, and instructions."""

import zipfile
from collections.abc import Iterator
from pathlib import Path

from tasklens.runtime.files import FileError, replacing

_LEFT_OUT = {"checkpoints", "images", "locks", "progress"}  # reproducible files, and files that only running jobs need
_WEIGHTS = {"classifiers", "restoration", "tasks"}


def files_of(folder: Path, weights: bool) -> Iterator[Path]:
    """Yield the files of a study's results that are exported."""
    left_out = _LEFT_OUT if weights else _LEFT_OUT | _WEIGHTS
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts[:-1]
        if path.is_file() and left_out.isdisjoint(parts[:2]) and not path.name.startswith("."):  # also of a point
            yield path


def export(folder: Path, output: Path, weights: bool) -> int:
    """Write a zip file of a study's results; return the number of files.

    Args:
        weights: include the weights of all networks.

    Raises:
        FileError: the folder has no study.
    """
    if not (folder / "study.yaml").is_file():
        raise FileError(f"{folder}: contains no study.yaml; expected the results of a study, results/<name>")
    folder = folder.resolve()  # `.` has no name
    files = list(files_of(folder, weights))
    with replacing(output) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{folder.name}/README.txt", _readme(folder, weights))
        for path in files:
            archive.write(path, Path(folder.name, path.relative_to(folder)))
    return len(files)


def _readme(folder: Path, weights: bool) -> str:
    return f"""\
Results of the study {folder.name}, made by TaskLens; the commit and the versions are in tables/*.json.

report.html   the results on one page, if it was made; figures/ has its drawings
study.yaml    the configuration, with every default
tables/       tables as CSV, Markdown and LaTeX; verdicts.csv: each claim with its interval
lenses/       prescription (lens.yaml), history of the design, PSFs (psf.safetensors) of every lens and seed
metrics/      accuracies by field, and predictions by image
benchmarks/   time and memory of every job; logs/ has their logs
{"classifiers/, restoration/, tasks/: weights of the networks" if weights else "The weights of networks are left out."}

To reproduce it:  snakemake -j2 tables --configfile study.yaml
"""
