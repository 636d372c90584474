"""Short description of the result of a finished job, read from its files."""

import re
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from tasklens.runtime.files import read_table, read_yaml
from tasklens.settings.names import SHARP
from tasklens.study.report.verification import ROUNDING


def outcome(rule: str, outputs: Sequence[str], log: Path) -> str:
    """Describe the result of a job: spot of a lens, accuracy, or path of a table; else the last line of its log."""
    paths = {Path(path).suffix: Path(path) for path in reversed(outputs)}  # the first file of each suffix
    if rule == "design":
        return _lens(paths[".yaml"])
    if rule == "production":
        design, *built = read_table(paths[".csv"])["accuracy"]
        return f"accuracy {design:.1f} %, of built lenses {mean(built):.1f} %"
    if rule == "task_fine_tune":
        rows = read_table(paths[".csv"])
        scores = rows[rows["tuned"]].groupby("metric", sort=False)["value"].mean()
        return ", ".join(f"{name} {value:.1f} %" for name, value in scores.items())
    if rule == "fine_tune":
        accuracy = read_table(paths[".csv"]).groupby("metric")["value"].mean()["accuracy"]
        return f"accuracy {accuracy:.1f} %" + (" on the sharp images" if f"/{SHARP}/" in str(paths[".csv"]) else "")
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
