"""Resources and provenance of a study: time and memory by kind of job, machine, commit, versions."""

import math
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import pandas

from tasklens.runtime.benchmarks import benchmarks
from tasklens.runtime.files import read_json


def durations(folder: Path) -> pandas.DataFrame:
    """Return a row per kind of job from Snakemake's benchmark files: jobs, time [min], longest job, memory [MB]."""
    rows = [
        {"job": rule.replace("_", " "), "minutes": job.seconds / 60, "memory_mb": job.memory_mb or math.nan}
        for rule, job in benchmarks(folder)
    ]
    if not rows:
        return pandas.DataFrame()
    jobs = pandas.DataFrame(rows).groupby("job")
    table = pandas.DataFrame(
        {
            "jobs": jobs.size(),
            "total_min": jobs["minutes"].sum(),
            "mean_min": jobs["minutes"].mean(),
            "longest_min": jobs["minutes"].max(),
            "memory_mb": jobs["memory_mb"].max(),
        }
    )
    return table.sort_values("total_min", ascending=False).reset_index()


def facts(provenance: Sequence[Path]) -> list[tuple[str, str]]:
    """Return facts about the machine that makes the page, and commits and versions that made the tables."""
    entries = [
        ("machine", f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"),
        ("Python", platform.python_version()),
    ]
    contents = [read_json(path) for path in provenance]
    commits = dict.fromkeys(content["commit"] for content in contents)
    versions: dict[str, dict[str, None]] = {}
    for content in contents:
        for package, version in content["versions"].items():
            versions.setdefault(package, {})[version] = None
    entries += [("commit of the tables", ", ".join(commits))] if commits else []
    return entries + [(package, ", ".join(numbers)) for package, numbers in versions.items()]
