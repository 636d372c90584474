"""The summary printed at the end of a run: the study's answer, the paths of its results, and the next commands."""

from collections.abc import Mapping
from pathlib import Path

from tasklens.runtime.files import read_table
from tasklens.study.loading import at_points, whole_study_name
from tasklens.study.report.page import words
from tasklens.study.report.verdicts import LEAST_SEEDS
from tasklens.study.report_jobs import ReportJob
from tasklens.study.run import runs
from tasklens.study.run.forecast import duration
from tasklens.study.study import Study

_SHOWN = (".md", ".html")  # results that a person reads
_MOST = 8  # of them in the summary printed at the end of a run


def success(study: Study, by_study: Mapping[str, runs.Run]) -> str:
    """Return the summary printed at the end of a run that finished all its jobs.

    Args:
        study: the study of the configuration.
        by_study: the run of each study, such as the points of a sweep; empty if no job had to run.
    """
    # a part ends before its study
    by_study = {name: run for name, run in by_study.items() if name == whole_study_name(name)}
    lines = [
        f"\nStudy {name}: {len(run.jobs)} job{'s' * (len(run.jobs) > 1)} in {duration(run.ended - run.started)}."
        for name, run in by_study.items()
        if run.ended is not None
    ]
    if study.sweep:
        return "\n".join(lines + _sweep(study, by_study))
    run = by_study.get(study.name)
    verdicts = _folder(study) / "tables" / "verdicts.csv"
    if verdicts.exists() and (not by_study or (run is not None and "verdicts_table" in run.jobs)):
        lines += _answer(study, verdicts)
    lines.append(f"Results: {', '.join(f'results/{name}/' for name in by_study or [study.name])}")
    page = str(_folder(study) / "report.html")
    paths = [job.result for state in by_study.values() for job in state.jobs.values() if job.result.endswith(_SHOWN)]
    listing = [path for path in paths if path.endswith(".html")] or paths[:_MOST]
    lines += [f"  {path}" for path in (listing if by_study else [page] if Path(page).exists() else [])]
    if by_study and study.name not in by_study:
        return "\n".join(lines)
    lines.append("Next:")
    lines += [f"  {command:<72} {meaning}" for command, meaning in _next(study, verdicts)]
    return "\n".join(lines)


def _folder(study: Study) -> Path:
    return Path("results", study.name)


def _sweep(study: Study, by_study: Mapping[str, runs.Run]) -> list[str]:
    table = _folder(study) / "sweep.md"
    lines = [table.read_text(encoding="utf-8")] if table.exists() and (not by_study or study.name in by_study) else []
    lines.append(f"Results: {_folder(study)}/")
    return lines + [f"  {page}" for point in at_points(study) if (page := _folder(point) / "report.html").exists()]


def _answer(study: Study, verdicts: Path) -> list[str]:
    """Return the answer of the study in sentences, as its page gives it."""
    frame = read_table(verdicts, keep_default_na=False)
    return [sentence.text for sentence in words.summary(frame, ReportJob.of(study))]


def _next(study: Study, verdicts: Path) -> list[tuple[str, str]]:
    file = f"--configfile {_folder(study)}/study.yaml"
    if not verdicts.exists():
        return [(f"snakemake -j2 tables {file}", "all tables and their verdicts")]
    commands = [
        (f"snakemake -j2 figures certificates {file}", "a drawing and a page of every lens"),
        (f"snakemake -j2 verify {file}", "limits checked, accuracies reproduced"),
    ]
    if len(study.seeds) < LEAST_SEEDS:
        more = ", ".join(map(str, range(LEAST_SEEDS)))
        commands.append((f"snakemake -j2 tables {file} --config 'seeds=[{more}]'", "verdicts instead of suggestions"))
    return commands


def failure(by_study: Mapping[str, runs.Run]) -> str:
    """Return the summary printed at the end of a run that had failed jobs or was stopped; arguments as `success`."""
    lines = [""]
    for name, run in by_study.items():
        lines.append(f"Study {name}: {len(run.labels(runs.DONE))} of {len(run.jobs)} jobs done.")
        for label in run.labels(runs.FAILED):
            lines.append(f"FAILED  {runs.title(label)}: {run.jobs[label].result or 'its log is empty'}")
            lines.append(f"        {run.folder}/logs/{label}.log")
    failed = any(run.labels(runs.FAILED) for run in by_study.values())
    hint = "; with --keep-going it runs all jobs that do not depend on a failed one" if failed else ""
    lines.append(f"The same command continues from here{hint}.")
    return "\n".join(lines)
