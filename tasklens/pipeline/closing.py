"""The last words of a run: the answer of the study, where its results are, and what to type next."""

from collections.abc import Mapping
from pathlib import Path

import pandas

from tasklens.pipeline import runs
from tasklens.pipeline.forecast import duration
from tasklens.report.page import words
from tasklens.report.verdicts import LEAST_SEEDS
from tasklens.study.loading import at_points
from tasklens.study.parts import owner
from tasklens.study.report_jobs import ReportJob
from tasklens.study.study import Study

_SHOWN = (".md", ".html")  # results that a person reads
_MOST = 8  # of them in the last words


def success(study: Study, found: Mapping[str, runs.Run]) -> str:
    """Return the last words of a run that did all its jobs.

    Args:
        study: the study of the configuration.
        found: the run of each study, such as the points of a sweep; empty if nothing was to be done.
    """
    found = {name: run for name, run in found.items() if name == owner(name)}  # a part ends long before its study
    lines = [
        f"\nStudy {name}: {len(run.jobs)} job{'s' * (len(run.jobs) > 1)} in {duration(run.ended - run.started)}."
        for name, run in found.items()
        if run.ended is not None
    ]
    if study.sweep:
        return "\n".join(lines + _sweep(study, found))
    run = found.get(study.name)
    verdicts = _folder(study) / "tables" / "verdicts.csv"
    if verdicts.exists() and (not found or (run is not None and "verdicts_table" in run.jobs)):
        lines += _answer(study, verdicts)
    lines.append(f"Results: {', '.join(f'results/{name}/' for name in found or [study.name])}")
    page = str(_folder(study) / "report.html")
    made = [job.result for each in found.values() for job in each.jobs.values() if job.result.endswith(_SHOWN)]
    shown = [path for path in made if path.endswith(".html")] or made[:_MOST]
    lines += [f"  {path}" for path in (shown if found else [page] if Path(page).exists() else [])]
    if found and study.name not in found:
        return "\n".join(lines)
    lines.append("Next:")
    lines += [f"  {command:<72} {meaning}" for command, meaning in _next(study, verdicts)]
    return "\n".join(lines)


def _folder(study: Study) -> Path:
    return Path("results", study.name)


def _sweep(study: Study, found: Mapping[str, runs.Run]) -> list[str]:
    table = _folder(study) / "sweep.md"
    lines = [table.read_text(encoding="utf-8")] if table.exists() and (not found or study.name in found) else []
    lines.append(f"Results: {_folder(study)}/")
    return lines + [f"  {page}" for each in at_points(study) if (page := _folder(each) / "report.html").exists()]


def _answer(study: Study, verdicts: Path) -> list[str]:
    """Return how many claims hold, and below it, by elements, the answers to the main questions."""
    frame = pandas.read_csv(verdicts, dtype={"lens": str, "baseline": str}, keep_default_na=False)
    settings = ReportJob.of(study)
    lines = [words.summary(frame, settings.margins, len(study.seeds))[0].text]
    for name, found in words.answers(frame, study.elements, settings.questions, settings.margins).items():
        lines += [f"{name}:", *(f"  {sentence.text}" for sentence in found)]
    return lines


def _next(study: Study, verdicts: Path) -> list[tuple[str, str]]:
    file = f"--configfile {_folder(study)}/study.yaml"
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


def failure(found: Mapping[str, runs.Run]) -> str:
    """Return the last words of a run in which jobs failed, or which was ended; `found` is that of `success`."""
    lines = [""]
    for name, run in found.items():
        lines.append(f"Study {name}: {len(run.labels(runs.DONE))} of {len(run.jobs)} jobs done.")
        for label in run.labels(runs.FAILED):
            lines.append(f"FAILED  {runs.title(label)}: {run.jobs[label].result or 'no word in its log'}")
            lines.append(f"        {run.folder}/logs/{label}.log")
    failed = any(run.labels(runs.FAILED) for run in found.values())
    others = "; with --keep-going it does all that needs no failed job" if failed else ""
    lines.append(f"The same command goes on from here{others}.")
    return "\n".join(lines)
