"""Parts of a study: their content, their files, and the priority of their jobs."""

import pytest
from rules import ROOT, job_of, workflow
from snakemake.iocontainers import Wildcards
from studies import tiny_study

from tasklens.study.loading import load, parse, parts, whole_study_name
from tasklens.study.study import Study


def three_counts(**changes) -> Study:
    """The tiny study with one to three elements."""
    elements = {"singlet": ["COC"], "doublet": ["COC", "OKP4"], "triplet": ["COC", "OKP4", "COC"]}
    return parse(tiny_study() | {"elements": elements} | changes)


def priority(rule: str, study: Study, part: str = "tiny", **wildcards: str) -> float:
    """The priority of a job of a study, or of a part of it."""
    job_of("images", study)  # the study of the workflow
    return workflow().get_rule(rule).expand_priority(Wildcards(fromdict={"study": part} | wildcards), None, 1)


def test_a_part_has_table_1_of_the_first_element_counts():
    study = three_counts(specs={"triplet": {"f_number": 2.0}}, restored=["triplet"])
    one, two = parts(study)
    assert [one.name, two.name] == ["tiny/elements=singlet", "tiny/elements=singlet+doublet"]
    assert list(two.elements) == ["singlet", "doublet"] and two.tables == ("table1",) and two.specs == {}
    assert two.lenses.keys() == {f"{count}-{name}" for count in ("singlet", "doublet") for name in study.designs}
    assert whole_study_name(two.name) == study.name == whole_study_name(study.name)


@pytest.mark.parametrize(
    "changes", [{"tables": ["table2"]}, {"sweep": {"spec.f_number": [2.8, 4]}}, {"elements": {"singlet": ["COC"]}}]
)
def test_no_parts_without_table_1_at_points_of_a_sweep_or_of_one_element_count(changes):
    assert parts(three_counts(**changes)) == []


def test_a_part_makes_its_own_tables_from_the_lenses_of_its_study():
    study = three_counts()
    part = parts(study)[0]
    table, page, captures = (
        job_of("table", study, study=part.name, table="table1"),
        job_of("report_page", study, study=part.name),
        job_of("captures", study, study=part.name),
    )
    assert {path.parts[:3] for path in table.reads if path.parts[0] == "results"} >= {("results", "tiny", "lenses")}
    for job in (table, page, captures):
        folders = {path.parts[:3] for path in job.outputs.values()}
        assert folders and all(parts[2] == "elements=singlet" for parts in folders)
        lenses = [path for path in job.reads if "lenses" in path.parts or "images" in path.parts]
        assert lenses and not any("elements=singlet" in path.parts for path in lenses)
        assert not any("doublet" in str(path) for path in job.reads)


def test_jobs_of_table_1_of_the_first_elements_come_first():
    study = three_counts()
    singlets, triplets = (priority("design", study, lens=f"{n}-tasklens", seed="0") for n in ("singlet", "triplet"))
    joint = priority("design", study, lens="singlet-end_to_end_from_flat", seed="0")  # of table 3 alone
    supervisor, other = (priority("reference", study, classifier=name) for name in ("small", "other"))
    fine_tuned = [
        priority("fine_tune", study, lens=lens, measured_name=name, seed="0")
        for lens, name in (("singlet-tasklens", "small"), ("triplet-tasklens", "small"), ("singlet-tasklens", "other"))
    ]
    page = priority("report_page", study, part=parts(study)[0].name)
    assert singlets > fine_tuned[0] > triplets > fine_tuned[1] > joint > fine_tuned[2] == other == 0
    assert supervisor > triplets and page > triplets


def test_the_default_study_shows_its_doublets_first():
    study = load(ROOT / "config" / "config.yaml")
    assert [part.name for part in parts(study)] == ["small/elements=doublet", "small/elements=doublet+triplet"]
