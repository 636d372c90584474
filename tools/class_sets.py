"""Write folders of photographs for sets of classes, as links into data sets: each data set alone, and mixtures of all.

    python tools/class_sets.py data/imagenette data/imagewoof -o data/class_sets --mixed 6 --each 100

A data set has train/<class>/* and val/<class>/* (`--test` names another folder). Mixed sets come in complementary
pairs, halves of all classes, so that each class is in half of them. A study sweeps over `images.folder`.
"""

import argparse
import random
from collections.abc import Sequence
from pathlib import Path


def class_sets(data_sets: Sequence[Path], test: str, mixed: int, seed: int) -> dict[str, list[Path]]:
    """Return the folders train/<class> of each set, by its name.

    Raises:
        SystemExit: a data set has no train folder, or a class no test photographs; two data sets share a name or a
            class; or the number of mixed sets is odd.
    """
    for folder in data_sets:
        if not (folder / "train").is_dir():
            raise SystemExit(f"{folder / 'train'}: no such folder; expected photographs train/<class>/*")
    if len({folder.name for folder in data_sets}) < len(data_sets):
        raise SystemExit("two data sets have the same name; rename a folder")
    alone = [sorted(path for path in (folder / "train").iterdir() if path.is_dir()) for folder in data_sets]
    classes = [path for paths in alone for path in paths]
    names = [path.name for path in classes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SystemExit(f"{twice[0]}: is a class of two data sets; expected different classes")
    for path in classes:
        if not (folder := path.parents[1] / test / path.name).is_dir():
            raise SystemExit(f"{folder}: no such folder; `--test` names that of the test photographs")
    if mixed % 2:
        raise SystemExit(f"--mixed {mixed}: expected an even number, since mixed sets come in pairs")
    sets = {folder.name: paths for folder, paths in zip(data_sets, alone, strict=True)}
    generator = random.Random(seed)
    for pair in range(mixed // 2):
        order = generator.sample(classes, len(classes))
        halves = order[: len(order) // 2], order[len(order) // 2 :]
        sets |= {f"mixed{2 * pair + k}": sorted(half) for k, half in enumerate(halves, 1)}
    return sets


def link(classes: Sequence[Path], test: str, each: int | None, output: Path) -> None:
    """Write links to the first `each` training photographs of each class, and to all its test photographs."""
    for source in classes:
        for split, folder, most in (("train", source, each), ("val", source.parents[1] / test / source.name, None)):
            target = output / split / source.name
            target.mkdir(parents=True)
            for photograph in sorted(folder.iterdir())[:most]:
                (target / photograph.name).symlink_to(photograph.resolve())


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the folders of all sets."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data_sets", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the sets; it must not exist")
    parser.add_argument("--test", default="val", help="folder of the test photographs of a data set")
    parser.add_argument("--mixed", type=int, default=6, help="number of mixed sets")
    parser.add_argument("--each", type=int, help="largest number of training photographs of a class")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.output.exists():
        raise SystemExit(f"{options.output}: exists already; remove it, or name another folder")
    for name, classes in class_sets(options.data_sets, options.test, options.mixed, options.seed).items():
        link(classes, options.test, options.each, options.output / name)
        print(f"{options.output / name}: {', '.join(path.name for path in classes)}")


if __name__ == "__main__":
    main()
