"""Jobs: which of them reads what of the study."""

import itertools

import pytest
import yaml
from examples import changed, tiny_study, with_outside
from tasklens.pipeline.layout import SHARP

from tasklens.materials.catalogues import builtin
from tasklens.pipeline import jobs
from tasklens.study import claims
from tasklens.study.study import TABLES, dump, parse


def slices(mapping: dict) -> dict[tuple, str]:
    """What Snakemake compares, for every job of a study."""
    study, found = parse(mapping), {("images",): jobs.images(parse(mapping))}
    for classifier in study.classifiers:
        found["reference", classifier] = jobs.reference(study, classifier)
        for lens, seed in itertools.product([SHARP, *study.lenses, *study.variants], study.seeds):
            for restored in (False, True) if lens != SHARP else (False,):
                key = "restored" if restored else "fine_tune", lens, classifier
                found[key] = jobs.fine_tune(study, lens, classifier, seed, restored)
                found["reproduce", *key] = jobs.reproduce(study, lens, classifier, restored)
    for lens, seed in itertools.product([*study.lenses, *study.variants], study.seeds):
        found["design", lens] = jobs.design(study, lens, seed)
        found["psf", lens] = jobs.psf(study, lens)
        found["restore", lens] = jobs.restore(study, lens, seed)
    for table in TABLES:
        found["table", table] = jobs.table(study, table)
    found["psf_tail",] = jobs.psf_tail(study)
    found["verdicts",] = claims.verdicts(study)
    for name in study.ablations:
        found["ablation", name] = claims.ablation(study, name)
    return {key: job.model_dump_json() for key, job in found.items()}


SUPERVISED = ("singlet-tasklens", "singlet-end_to_end_from_imaging", "singlet-end_to_end_from_flat")
READERS = [
    ("fine_tuning.learning_rate", 3e-3, lambda job: job[0] in ("fine_tune", "restored")),
    ("minutes.design", 7, lambda job: False),
    ("images.seed", 5, lambda job: job == ("images",)),
    ("evaluation_rays", 128, lambda job: job[0] in ("psf", "design")),
    ("spec.pixel_pitch_um", 2.0, lambda job: job[0] in ("psf", "design")),
    ("constraints.max_track", 4.0, lambda job: job[0] == "design"),
    ("designs.imaging1.steps", 4, lambda job: job == ("design", "singlet-imaging1")),
    ("restoration.steps", 9, lambda job: job[0] in ("restore", "restored") or job[:2] == ("reproduce", "restored")),
    ("restored", [], lambda job: job in (("table", "table4"), ("verdicts",))),
    ("capture.outside_window", "renormalise",
     lambda job: job[0] in ("restore", "restored") or (job[0] == "fine_tune" and job[1] != SHARP)
     or (job[0] == "reproduce" and job[2] != SHARP) or (job[0] == "design" and job[1] in SUPERVISED)),
    ("classifiers.small.training.learning_rate", 2e-3,
     lambda job: job == ("reference", "small")
     or (job[0] in ("fine_tune", "restored", "reproduce") and job[-1] == "small")
     or (job[0] == "design" and job[1] in SUPERVISED)),
    ("classifiers.other.model", "test_vit2",
     lambda job: job == ("reference", "other")
     or (job[0] in ("fine_tune", "restored", "reproduce") and job[-1] == "other")),
    ("elements.singlet", ["PMMA"], lambda job: job[0] == "design"),
]  # fmt: skip


@pytest.mark.parametrize("key, value, reads", READERS, ids=[key for key, *_ in READERS])
def test_a_changed_value_reaches_the_jobs_that_read_it_and_no_others(key, value, reads):
    before, after = slices(tiny_study()), slices(changed(tiny_study(), key, value))
    assert before.keys() == after.keys()
    touched = {job for job in before if before[job] != after[job]}
    assert touched == {job for job in before if reads(job)}


def test_editing_a_plastic_redesigns_the_lenses_that_use_it_and_no_others():
    study = changed(tiny_study(), "elements", {"doublet": ["OKP4", "MINE"], "singlet": ["COC"]})
    mine = builtin("COC").definition()
    before = slices(study | {"materials": {"MINE": mine}})
    after = slices(study | {"materials": {"MINE": mine | {"coefficients": [2.31, 0.01, 0.037, 0, 0, 0]}}})
    touched = {job for job in before if before[job] != after[job]}
    assert touched == {job for job in before if job[0] == "design" and job[1].startswith("doublet")}


def test_tables_hold_the_lenses_of_the_paper():
    """Task-driven against imaging; in table 3 against end-to-end; in table 2 with all classifiers."""
    study = parse(tiny_study())
    found = {name: jobs.table(study, name) for name in TABLES}
    imaging = ("singlet-tasklens", "singlet-imaging1", "singlet-imaging2")
    assert all(found[name].lenses == imaging for name in ("table1", "table2", "table4"))
    assert found["table3"].lenses == SUPERVISED
    assert found["table2"].classifiers == ("small", "other")
    assert all(found[name].classifiers == ("small",) for name in ("table1", "table3", "table4"))


def test_a_study_may_make_some_of_the_tables():
    """Its tails, verdicts and verification are of these, of their lenses and of their measurements."""
    some = changed(tiny_study(), "tables", ["table3"])
    before, after = slices(tiny_study()), slices(some)
    assert {job for job in before if before[job] != after[job]} == {("psf_tail",), ("verdicts",)}
    study = parse(some)
    assert jobs.psf_tail(study).lenses == jobs.verify(study).lenses == SUPERVISED
    assert {classifier for _, classifier in jobs.verify(study).measured} == {"small"}
    assert {claim.table for claim in claims.verdicts(study).claims} == {"table3"}
    assert {claim.table for claim in claims.verdicts(parse(tiny_study())).claims} == {*TABLES}


def test_a_lens_from_outside_adds_rows_and_changes_no_other_job():
    """It stands beside the imaging designs, last; nothing starts from it, and its own design reads no classifier."""
    before, after = slices(tiny_study()), slices(with_outside())
    tables = {("table", name) for name in ("table1", "table2", "table4")} | {("psf_tail",)}
    assert {job for job in before if before[job] != after[job]} == tables
    assert all("quadruplet-phone" in job for job in after.keys() - before.keys())
    study = parse(with_outside())
    for name in TABLES:
        imported = () if name == "table3" else ("quadruplet-phone",)
        assert jobs.table(study, name).lenses == jobs.table(parse(tiny_study()), name).lenses + imported
    assert jobs.design(study, "quadruplet-phone", 0).classifier is None
    assert jobs.imaging_baselines(study, "quadruplet-phone") == ()


def test_rivals_are_the_imaging_lenses_of_the_same_elements():
    study = parse(changed(tiny_study(), "elements.doublet", ["COC", "OKP4"]))
    expected = ("doublet-imaging1", "doublet-imaging2")
    assert jobs.imaging_baselines(study, "doublet-end_to_end_from_imaging") == expected
    assert jobs.imaging_baselines(study, "doublet-end_to_end_from_flat") == ()
    assert jobs.imaging_baselines(study, "doublet-tasklens") == ()


def test_a_specification_of_its_own_changes_the_lenses_of_these_elements_alone():
    """Other designs, PSFs and focal lengths to verify for doublets, which are no baselines of singlets then."""
    study = changed(tiny_study(), "elements.doublet", ["COC", "OKP4"])
    before, after = slices(study), slices(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    found = {job for job in before if before[job] != after[job]}
    doublets = {job for job in before if job[0] in ("design", "psf") and job[1].startswith("doublet")}
    assert found == doublets | {("verdicts",)}
    both = parse(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    efl_mm = jobs.verify(both).efl_mm
    assert efl_mm["singlet-imaging1"] == both.spec.efl_mm < efl_mm["doublet-imaging1"]
    assert parse(yaml.safe_load(dump(both))) == both
