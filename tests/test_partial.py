"""The report of a half-finished study by hand: what is made first of what is there."""

import pytest
from examples import tiny_study, write

from tasklens.pipeline import figure_jobs, jobs, partial, report_jobs
from tasklens.runtime.files import FileError
from tasklens.study.loading import parse

STUDY = parse(tiny_study())


@pytest.fixture
def made(tmp_path, monkeypatch):
    """The jobs that are run, in a folder with one finished lens and table 1; nothing of table 3 is measured."""
    monkeypatch.chdir(tmp_path)
    for name in ("lens", "psf"):
        write(jobs.design.output(STUDY, name, lens="singlet-imaging1", seed=0), "")
    write(jobs.design.output(STUDY, "lens", lens="singlet-imaging2", seed=0), "")  # killed before its PSFs
    write(report_jobs.table.output(STUDY, "csv", table="table1"), "")
    found = []

    def run(stage, study, wildcards, partial=False):
        if wildcards == {"table": "table3"}:
            raise FileError("table3: nothing has been measured yet")
        found.append((stage.name, *wildcards.values(), partial))

    monkeypatch.setattr(partial, "run", run)
    return found


def test_tables_drawings_and_captures_are_made_of_what_is_there(made, capsys):
    """Partial ones of what is not complete; what cannot be made is said, and stops nothing."""
    partial.prepare(STUDY)
    assert made == [
        ("table", "table2", True),
        ("table", "table4", True),
        ("certificate", "singlet-imaging1", 0, False),
        ("captures", True),
    ]
    assert capsys.readouterr().err == "tasklens: table3: nothing has been measured yet\n"


def test_what_is_complete_is_not_made_again(made):
    partial.prepare(STUDY)
    for stage, output, wildcards in (
        (figure_jobs.certificate, "page", {"lens": "singlet-imaging1", "seed": 0}),
        (figure_jobs.captures, "answers", {}),
    ):
        write(stage.output(STUDY, output, **wildcards), "")
    made.clear()
    partial.prepare(STUDY)
    assert {job[0] for job in made} == {"table"}
