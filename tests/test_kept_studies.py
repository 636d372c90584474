"""A job computes what its rule was planned with, whatever other runs of a study of the same name have written since."""

import pytest
from examples import changed, tiny_study, write
from test_workflow import snakemake

from tasklens.cli.app import main
from tasklens.pipeline import jobs, kept_studies
from tasklens.study.loading import dump, load, parse

LENS = {"lens": "singlet-imaging1", "seed": 0}
STEPS = "designs.imaging1.descents.0.steps"


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(planned: str) -> int:
    return main(["run", "design", "results/tiny/study.yaml", LENS["lens"], "--seed", "0", "--plan", planned])


def test_a_job_takes_the_study_that_it_was_planned_with(place):
    """Two runs keep their studies; the second one has stored its own, of two steps more."""
    first, second = (parse(changed(tiny_study(), STEPS, steps)) for steps in (3, 5))
    kept_studies.keep(first)
    kept_studies.keep(second)
    write("results/tiny/study.yaml", dump(second))
    for study, steps in ((first, 3), (second, 5)):
        assert run(kept_studies.digest(jobs.design.plan(study, **LENS))) == 0
        history = jobs.design.output(study, "history", **LENS).read_text().splitlines()
        assert len(history) == 1 + steps


def test_a_job_that_nothing_was_planned_with_is_refused(place, capsys):
    """Among kept studies one of an older version, and one without the lens."""
    study = parse(tiny_study())
    write("results/tiny/study.yaml", dump(study))
    write("results/tiny/studies/old.yaml", "format: 1\n")
    write("results/tiny/studies/other.yaml", dump(study).replace("imaging1", "other1"))
    assert run("0123456789abcdef") == 2
    assert "not what this job was planned with; start the run again" in capsys.readouterr().err
    assert not jobs.design.output(study, "lens", **LENS).exists()


def test_inputs_are_part_of_the_plan():
    """The same training of other weights is another job."""
    study = parse(tiny_study())
    small, other = (jobs.reference.plan(study, classifier=name) for name in ("small", "other"))
    assert kept_studies.digest(small) != kept_studies.digest(other)
    assert kept_studies.digest(small) == kept_studies.digest(jobs.reference.plan(study, classifier="small"))


def test_a_study_that_fails_its_check_is_not_stored(place):
    """A network that timm does not have: what the last run stored stays."""
    before = parse(tiny_study())
    write("results/tiny/study.yaml", dump(before))
    done = snakemake(place, changed(tiny_study(), "classifiers.small.model", "resnet_of_nobody"), "table1")
    assert done.returncode != 0 and "resnet_of_nobody" in done.stdout + done.stderr
    assert load("results/tiny/study.yaml") == before and not (place / "results/tiny/lenses").exists()
