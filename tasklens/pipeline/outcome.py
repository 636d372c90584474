"""What came out of a finished job, in a few words, from its files."""

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from statistics import mean

from tasklens.pipeline.stage import STAGES
from tasklens.report.verification import ROUNDING
from tasklens.runtime.files import read_yaml
from tasklens.study.names import SHARP
from tasklens.study.study import Study


def outcome(study: Study, stage: str, wildcards: Mapping[str, str], log: Path) -> str:
    """Say what a job has made: the spot of a lens, accuracies, where a table is; else the last line of its log."""
    outputs = STAGES[stage].outputs(study, **wildcards)
    if stage == "design":
        return _lens(outputs["lens"])
    if stage == "production":
        return _built(outputs["lenses"])
    if stage == "task_fine_tune":
        return _scores(outputs["metrics"])
    accuracies = {name: _accuracy(path) for name, path in outputs.items() if name.startswith("metrics")}
    if accuracies:
        named = [
            f"{name.removeprefix('metrics').strip('_')} {value:.1f} %".strip() for name, value in accuracies.items()
        ]
        return f"accuracy {', '.join(named)}" + (" on the sharp images" if wildcards.get("lens") == SHARP else "")
    shown = outputs.get("md") or outputs.get("page") or outputs.get("figure")
    return str(shown) if shown else _last_line(log)


def _lens(path: Path) -> str:
    content = read_yaml(path)
    words = [f"RMS spot {mean(content['figures']['rms_centroid_um']):.1f} um"]
    if "validation_loss" in content["origin"]:
        words.append(f"loss {content['origin']['validation_loss']:.3g}")
    if content["worst_margin"]["value"] < -ROUNDING:
        words.append(f"violates {content['worst_margin']['limit']}")
    return ", ".join(words)


def _built(path: Path) -> str:
    with open(path, newline="") as file:
        design, *built = (float(row["accuracy"]) for row in csv.DictReader(file))
    return f"accuracy {design:.1f} %, of built lenses {mean(built):.1f} %"


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
    """Return the last lines of a log that are not blank; none where it does not exist."""
    try:
        return [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()][
            -count:
        ]
    except OSError:
        return []
