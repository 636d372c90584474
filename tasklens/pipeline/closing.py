"""The last words of a run: the answer of the study, where its results are, and what to type next."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas

from tasklens.pipeline import report_jobs, runs
from tasklens.pipeline.forecast import duration
from tasklens.pipeline.stage import results, study_file
from tasklens.report.page import words
from tasklens.report.verdicts import LEAST_SEEDS
from tasklens.study.loading import at_points
from tasklens.study.study import Study


def success(study: Study, found: Mapping[str, runs.Run]) -> str:
    """Return the last words of a run that did all its jobs.

    Args:
        found: the run of each study: of a sweep one for each point; empty where nothing was to be done.
    """
    return _sweep(study, found) if study.sweep else _study(study, found.get(study.name))


def _sweep(study: Study, found: Mapping[str, runs.Run]) -> str:
    table = report_jobs.sweep.output(study, "md")
    lines = []
    if found:
        jobs = sum(len(run.jobs) for run in found.values())
        took = max((run.ended or run.started) - run.started for run in found.values())
        lines.append(f"\nStudy {study.name}: {jobs} jobs in {duration(took)}.")
    if table.exists() and (not found or study.name in found):
        lines.append(table.read_text(encoding="utf-8"))
    lines.append(f"Results: {results(study)}/")
    lines += [f"  {path}" for each in at_points(study) if (path := report_jobs.report.output(each, "report")).exists()]
    return "\n".join(lines)


def _study(study: Study, run: runs.Run | None) -> str:
    verdicts = report_jobs.verdicts.output(study, "csv")
    lines = []
    if run is not None and run.ended is not None:
        lines.append(f"\nStudy {study.name}: {len(run.jobs)} jobs in {duration(run.ended - run.started)}.")
    if verdicts.exists() and (run is None or report_jobs.verdicts.name in run.jobs):
        lines += _answer(study, verdicts)
    lines.append(f"Results: {results(study)}/")
    page = report_jobs.report.output(study, "report")
    made = [job.result for job in run.jobs.values() if job.result.endswith(".md")] if run else []
    lines += [f"  {path}" for path in ([page] if page.exists() else made)]
    lines.append("Next:")
    lines += [f"  {command:<72} {meaning}" for command, meaning in _next(study, verdicts)]
    return "\n".join(lines)


def _answer(study: Study, verdicts: Path) -> list[str]:
    """Return how many claims hold, and below it, by elements, the answers to the main questions."""
    frame = pandas.read_csv(verdicts, dtype={"lens": str, "baseline": str}, keep_default_na=False)
    settings: Any = report_jobs.report.plan(study).settings
    lines = [words.summary(frame, settings.margins, len(study.seeds))[0].text]
    for name, found in words.answers(frame, study.elements, settings.questions, settings.margins).items():
        lines += [f"{name}:", *(f"  {sentence.text}" for sentence in found)]
    return lines


def _next(study: Study, verdicts: Path) -> list[tuple[str, str]]:
    file = f"--configfile {study_file(study)}"
    if not verdicts.exists():
        return [(f"snakemake -j2 tables {file}", "all tables and their verdicts")]
    found = [
        (f"snakemake -j2 figures certificates {file}", "a drawing and a page of every lens"),
        (f"snakemake -j2 verify {file}", "limits checked, accuracies reproduced"),
    ]
    if len(study.seeds) < LEAST_SEEDS:
        more = ", ".join(map(str, range(LEAST_SEEDS)))
        found.append((f"snakemake -j2 tables {file} --config 'seeds=[{more}]'", "verdicts in place of suggestions"))
    return found


def failure(study: Study, found: Mapping[str, runs.Run]) -> str:
    """Return the last words of a run in which jobs failed, or which was ended; its arguments are those of `success`."""
    lines = [""]
    for name, run in found.items():
        lines.append(f"Study {name}: {len(run.labels(runs.DONE))} of {len(run.jobs)} jobs done.")
        for label in run.labels(runs.FAILED):
            lines.append(f"FAILED  {runs.title(label)}: {run.jobs[label].result or 'no word in its log'}")
            lines.append(f"        {run.folder}/logs/{label}.log")
    failed = any(run.labels(runs.FAILED) for run in found.values())
    others = "; with --keep-going it does all that needs no failed job" if failed else ""
    lines.append(f"The same command goes on from here{others}.")
    for each in at_points(study):
        if not study.sweep or (each.name in found and found[each.name].labels(runs.FAILED)):
            partial = report_jobs.table.command(each, {"table": each.tables[0]})
            lines.append(f"Tables of what has finished: {partial} --partial")
    return "\n".join(lines)
