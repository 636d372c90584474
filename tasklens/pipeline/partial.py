"""The report of a study that is not finished: what it needs is made of what is there."""

import sys
from typing import Any

from tasklens.pipeline import figure_jobs, report_jobs
from tasklens.pipeline.jobs import lens_file, psf_file
from tasklens.pipeline.run import run
from tasklens.pipeline.stage import Stage
from tasklens.runtime.files import FileError
from tasklens.study.study import Study


def prepare(study: Study) -> None:
    """Make partial tables, the drawings of the lenses that are designed, and their captures, unless they are made.

    What cannot be made yet is said on standard error; the report lists it as missing.
    """
    settings: Any = report_jobs.report.plan(study).settings
    seed = study.seeds[0]
    for name in settings.tables:
        _make(report_jobs.table, "csv", study, table=name)
    for lens in settings.elements:
        psf = psf_file(study, lens, seed)
        if lens_file(study, lens, seed).exists() and psf is not None and psf.exists():
            _make(figure_jobs.certificate, "page", study, lens=lens, seed=seed)
    _make(figure_jobs.captures, "answers", study)


def _make(stage: Stage, output: str, study: Study, **wildcards: str | int) -> None:
    """Run a job as far as its inputs are there, unless its output is there."""
    if stage.output(study, output, **wildcards).exists():
        return
    try:
        run(stage, study, wildcards, partial=stage is not figure_jobs.certificate)
    except FileError as error:
        print(f"tasklens: {error}", file=sys.stderr)
