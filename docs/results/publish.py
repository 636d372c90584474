"""Copy tables of a finished study into this folder: `python docs/results/publish.py STUDY [--to FOLDER] [--lenses]`.

The program reads results/STUDY in the current folder and replaces the tables, answers and figure of docs/results/STUDY,
or of another folder beside it. Each point of a sweep has a folder of its own. With `--lenses`, the lenses of the first
seed come too.
"""

import argparse
import shutil
from pathlib import Path

import yaml

FOLDER = Path(__file__).parent
TABLES = ("*.csv", "*.md", "*.npz")
OMITTED = ("answers.csv", "encircled_energy.csv", "psf_tail.fields.csv")  # of the page; verdicts.npz has all answers


def publish(results: Path, destination: Path) -> None:
    """Copy the tables and answers of a study, or of a point of a sweep."""
    destination.mkdir(parents=True, exist_ok=True)
    for old in (path for pattern in TABLES for path in destination.glob(pattern)):
        if old.name != "README.md":
            old.unlink()
    sources = [path for pattern in TABLES for path in (results / "tables").glob(pattern)]
    for path in (*sources, *results.glob("effort.*"), *results.glob("sweep.*")):
        if path.name not in OMITTED:
            shutil.copyfile(path, destination / path.name)


def publish_lenses(results: Path, destination: Path) -> None:
    """Copy the tables' lenses of the first seed as YAML and Zemax files; variants of ablations have no Zemax file."""
    seed = yaml.safe_load((results / "study.yaml").read_text())["seeds"][0]
    lenses = [path.parent for path in results.glob(f"lenses/*/seed{seed}/*.zmx")]
    if not lenses:
        raise SystemExit(f"{results}/lenses: no Zemax files of seed {seed}; the published lenses remain")
    shutil.rmtree(destination, ignore_errors=True)
    destination.mkdir()
    for folder in lenses:
        shutil.copyfile(folder / "lens.yaml", destination / f"{folder.parent.name}.yaml")
        for path in (*folder.glob("*.zmx"), *(file for file in folder.glob("*.agf") if file.stat().st_size)):
            shutil.copyfile(path, destination / path.name)


def main() -> None:
    """Publish the study of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", metavar="STUDY")
    parser.add_argument("--to", metavar="FOLDER")
    parser.add_argument("--lenses", action="store_true")
    options = parser.parse_args()
    results, published = Path("results") / options.study, FOLDER / (options.to or options.study)
    if not results.is_dir():
        parser.error(f"{results}: no such folder; run the study first")
    points = [path.parent for path in results.glob("*=*/tables") if not path.parent.name.startswith("elements=")]
    for folder in (results, *points):
        publish(folder, published / folder.relative_to(results))
    for path in results.glob("answer.svg"):  # a sweep has none of its own
        shutil.copyfile(path, published / path.name)
    if options.lenses:
        publish_lenses(results, published / "lenses")


if __name__ == "__main__":
    main()
