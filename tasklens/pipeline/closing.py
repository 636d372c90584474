"""The last words of a run: the answer of the study, where its results are, and what to type next."""

from pathlib import Path
from typing import Any

import pandas

from tasklens.pipeline import report_jobs, runs
from tasklens.pipeline.forecast import duration
from tasklens.pipeline.stage import STAGES, results
from tasklens.report.page import words
from tasklens.study.study import Study

_ENOUGH_SEEDS = 5  # of which verdicts are more than suggestions


def success(study: Study, run: runs.Run | None) -> str:
    """Return the last words of a run that did all its jobs; of None, where nothing was to be done."""
    verdicts = report_jobs.verdicts.output(study, "csv")
    lines = []
    if run is not None and run.ended is not None:
        lines.append(f"\nStudy {study.name}: {len(run.jobs)} jobs in {duration(run.ended - run.started)}.")
    if verdicts.exists() and (run is None or report_jobs.verdicts.name in run.jobs):
        lines += _answer(study, verdicts)
    lines.append(f"Results: {results(study)}/")
    page = Path(results(study), "report.html")
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
    file = f"--configfile {results(study)}/study.yaml"
    if not verdicts.exists():
        return [(f"snakemake -j2 tables {file}", "all tables and their verdicts")]
    found = [
        (f"snakemake -j2 figures certificates {file}", "a drawing and a page of every lens"),
        (f"snakemake -j2 verify {file}", "limits checked, accuracies reproduced"),
    ]
    if len(study.seeds) < _ENOUGH_SEEDS:
        more = ", ".join(map(str, range(_ENOUGH_SEEDS)))
        found.append((f"snakemake -j2 tables {file} --config 'seeds=[{more}]'", "verdicts in place of suggestions"))
    return found


def failure(study: Study, run: runs.Run | None) -> str:
    """Return the last words of a run in which jobs failed, or which was ended."""
    stored = f"{results(study)}/study.yaml"
    lines = []
    if run is not None:
        lines.append(f"\nStudy {study.name}: {len(run.labels(runs.DONE))} of {len(run.jobs)} jobs done.")
        for label in run.labels(runs.FAILED):
            lines.append(f"FAILED  {runs.title(label)}: {run.jobs[label].result or 'no word in its log'}")
            lines.append(f"        {results(study)}/logs/{label}.log")
    partial = STAGES["table"].command(study, {"table": study.tables[0]}, stored)
    lines.append("The same command goes on from here; with --keep-going it does all that needs no failed job.")
    lines.append(f"Tables of what has finished: {partial} --partial")
    return "\n".join(lines)
