"""The study that is killed here, the code that runs it, and its results to compare."""

import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from studies import changed, tiny_study  # noqa: E402

TARGETS = ["table1", "table4", "verdicts"]
MEASURED = ("run.json", "effort.csv", "effort.md", "benchmarks", "logs", "studies", "locks")  # they differ by times


def small_study() -> dict:
    """The study of the tests with loops of several seconds, one network, and a lens of every start and optimizer."""
    study = tiny_study()
    del study["classifiers"]["other"]
    for name in ("image_error", "imaging2", "end_to_end_from_flat"):
        del study["designs"][name]
    for key, value in {
        "images.train": 200,
        "classifiers.small.training.epochs": 10,
        "designs.tasklens.descents.0.steps": 15,
        "designs.imaging1.descents.0.steps": 300,
        "designs.end_to_end_from_imaging.descents.0.steps": 30,
        "fine_tuning.epochs": 4,
        "restoration.steps": 30,
        "tables": TARGETS[:2],
    }.items():
        study = changed(study, key, value)
    return study


def copy_code(folder: Path) -> None:
    """Copy the workflow and the code, with frequent checkpoints."""
    for name in ("workflow", "profiles", "config", "tasklens", "restoration"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "Snakefile", folder)
    path = folder / "tasklens/runtime/checkpoints.py"
    assert "INTERVAL = 60.0" in path.read_text()
    path.write_text(path.read_text().replace("INTERVAL = 60.0", "INTERVAL = 0.5"))


def contents(folder: Path) -> dict[str, bytes]:
    """All results of a study but those with measured times."""
    results = folder / "results/tiny"
    paths = [path for path in results.rglob("*") if path.is_file() and path.suffix != ".lock"]
    by_name = {str(path.relative_to(results)): path.read_bytes() for path in paths}
    return {name: content for name, content in by_name.items() if name.split("/")[0] not in MEASURED}


def differences(actual: dict[str, bytes], expected: dict[str, bytes]) -> list[str]:
    """Return the files that differ, are missing (-), or are left over (+), such as checkpoints and temporary files."""
    names = [name for name in sorted(expected | actual) if actual.get(name) != expected.get(name)]
    return [("-" if name not in actual else "+" if name not in expected else "") + name for name in names]
