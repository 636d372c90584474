"""Short description of the result of a finished job, read from its files."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from tasklens.report.verification import ROUNDING
from tasklens.runtime.files import read_yaml
from tasklens.study.names import SHARP


def outcome(rule: str, outputs: Sequence[str], log: Path) -> str:
    """Describe the result of a job: spot of a lens, accuracy, or path of a table; else the last line of its log."""
    paths = {Path(path).suffix: Path(path) for path in reversed(outputs)}  # the first file of each suffix
    if rule == "design":
        return _lens(paths[".yaml"])
    if rule == "production":
        return _built(paths[".csv"])
    if rule == "task_fine_tune":
        return _scores(paths[".csv"])
    if rule == "fine_tune":
        sharp = f"/{SHARP}/" in str(paths[".csv"])
        return f"accuracy {_accuracy(paths['.csv']):.1f} %" + (" on the sharp images" if sharp else "")
    document = paths.get(".md") or paths.get(".html") or paths.get(".png")
    return str(document) if document else _last_line(log)


def _lens(path: Path) -> str:
    content = read_yaml(path)
    words = [f"RMS spot {mean(content['figures']['rms_centroid_um']):.1f} um"]
    if "validation_loss" in content["origin"]:
        words.append(f"loss {content['origin']['validation_loss']:.3g}")
    if content["worst_margin"]["value"] < -ROUNDING and content["origin"]["method"] != "file":
        words.append(f"violates {content['worst_margin']['limit']}")
    return ", ".join(words)


def _built(path: Path) -> str:
    with open(path, newline="") as file:
        design, *accuracies = (float(row["accuracy"]) for row in csv.DictReader(file))
    return f"accuracy {design:.1f} %, of built lenses {mean(accuracies):.1f} %"


def _scores(path: Path) -> str:
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["tuned"] == "True"]
    metrics = dict.fromkeys(row["metric"] for row in rows)
    means = {name: mean(float(row["value"]) for row in rows if row["metric"] == name) for name in metrics}
    return ", ".join(f"{name} {value:.1f} %" for name, value in means.items())


def _accuracy(path: Path) -> float:
    with open(path, newline="") as file:
        return mean(float(row["value"]) for row in csv.DictReader(file) if row["metric"] == "accuracy")


def _last_line(log: Path) -> str:
    lines = last_lines(log, 1)
    return re.sub(r"^.*  step \d+/\d+  (.*?)(  )?remaining .*$", r"\1", lines[0]) if lines else ""


def last_lines(log: Path, count: int) -> list[str]:
    """Return the last non-blank lines of a log; none if it does not exist."""
    try:
        return [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()][
            -count:
        ]
    except OSError:
        return []
