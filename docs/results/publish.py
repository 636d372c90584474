"""Copy the tables of a finished study into this folder: `python docs/results/publish.py STUDY`.

The program reads results/STUDY in the current folder and replaces the tables, answers and figure of docs/results/STUDY,
or with `--to FOLDER` of another folder beside it. Each point of a sweep has a folder of its own. With `--elements NAME`
the tables of lenses with these elements come too, and with `--lenses` the lenses of the first seed.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import yaml

FOLDER = Path(__file__).parent
TABLES = ("*.csv", "*.md", "*.npz")
OMITTED = ("answers.csv", "encircled_energy.csv", "psf_tail.fields.csv")  # of the page; verdicts.npz has all answers


def publish(folders: Sequence[Path], destination: Path) -> None:
    """Copy the tables, answers and figure of a study, or of a point of a sweep, from the folders of its results."""
    destination.mkdir(parents=True, exist_ok=True)
    for old in (path for pattern in TABLES for path in destination.glob(pattern)):
        if old.name != "README.md":
            old.unlink()
    for folder in folders:
        sources = [path for pattern in TABLES for path in (folder / "tables").glob(pattern)]
        for path in (*sources, *folder.glob("effort.*"), *folder.glob("sweep.*"), *folder.glob("answer.svg")):
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
    parser.add_argument("--elements", metavar="NAME")
    parser.add_argument("--lenses", action="store_true")
    options = parser.parse_args()
    results, published = Path("results") / options.study, FOLDER / (options.to or options.study)
    if not results.is_dir():
        parser.error(f"{results}: no such folder; run the study first")
    publish([results, *results.glob(f"elements={options.elements}")], published)
    for path in (path.parent for path in results.glob("*=*/tables")):  # the points of a sweep
        if not path.name.startswith("elements="):
            publish([path], published / path.name)
    if options.lenses:
        publish_lenses(results, published / "lenses")


if __name__ == "__main__":
    main()
