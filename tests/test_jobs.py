"""A change of a study reaches the jobs that read it and no others."""

import pytest
import torch
import yaml
from designs import OWN
from rules import finish, job_of, reached, slices
from safetensors.torch import load_file
from studies import changed, lens_file, one_lens, tiny_study, with_imported

from tasklens.materials.catalogues import builtin
from tasklens.settings.names import SHARP
from tasklens.study import claims, table_contents
from tasklens.study.loading import dump, parse
from tasklens.study.report_jobs import CapturesJob
from tasklens.study.study import TABLES, StudyError

CLASSIFIED = ("singlet-tasklens", "singlet-end_to_end_from_imaging", "singlet-end_to_end_from_flat")
SUPERVISED = (*CLASSIFIED, "singlet-image_error")
RESTORED = ("small-restored", "other-restored")


def measures(*measured_names: str):
    """Return whether a job measures classifiers with these names, for the first time or again."""
    return lambda job: job[0] in ("fine_tune", "reproduce") and job[2] in measured_names


def of_gradients(*rules: str):
    """Return whether a job is of these rules, and of a lens by gradient; another has no fields of its own."""
    return lambda job: job[0] in rules and job[1] not in (SHARP, "singlet-imaging2")


FIELDS = [list(point) for point in OWN]  # as a study file has them
READERS = [
    ("fine_tuning.learning_rate", 3e-3, lambda job: job[0] == "fine_tune"),
    ("images.seed", 5, lambda job: job[0] in ("images", "design")),
    ("evaluation_rays", 128, lambda job: job[0] in ("psf_tail_table", "design", "psfs")),
    ("spec.pixel_pitch_um", 2.0, lambda job: job[0] in ("psf_tail_table", "design", "psfs", "production")),
    ("constraints.max_track", 4.0, lambda job: job[0] == "design"),
    ("designs.imaging1.descents.0.steps", 4,
     lambda job: job in (("design", "singlet-imaging1"), ("effort_table",))),
    ("restoration.steps", 9, lambda job: job[0] in ("restore", "captures") or measures(*RESTORED)(job)),
    ("capture.outside_window", "renormalise",
     lambda job: job[0] in ("restore", "captures", "frames", "production", "merit_function_table")
     or (job[0] in ("fine_tune", "reproduce") and job[1] != SHARP)
     or (job[0] == "design" and job[1] in SUPERVISED)),
    ("classifiers.small.training.learning_rate", 2e-3,
     lambda job: job in (("reference", "small"), ("captures",)) or measures("small", "small-restored")(job)
     or job[0] == "production" or (job[0] == "design" and job[1] in CLASSIFIED)),
    ("classifiers.other.model", "test_vit2",
     lambda job: job in (("reference", "other"), ("captures",)) or measures("other", "other-restored")(job)),
    ("tolerances.grade", "phone_moulding",
     lambda job: job[0] in ("certificate", "production", "ranking_table", "tolerances_table")),
    ("tolerances.images", 10, lambda job: job[0] in ("production", "tolerances_table")),
    ("tolerances.designs", ["imaging1"], lambda job: job == ("tolerances_table",)),
    ("elements.singlet", ["PMMA"], lambda job: job[0] == "design"),
    ("fields.design", "paper", of_gradients("design", "fine_tune")),  # PSFs at the nine are stored in any case
    ("fields.design", FIELDS, of_gradients("design", "fine_tune", "psfs")),
    ("fields.grading", FIELDS,
     lambda job: job[0] in ("psfs", "frames", "production", "psf_tail_table")),  # others read the PSFs
    ("fields.nine", True, lambda job: job[0] == "fine_tune" and job[1] != SHARP),  # sharp images have no fields
]  # fmt: skip


@pytest.mark.parametrize("key, value, reads", READERS, ids=[key for key, *_ in READERS])
def test_a_changed_value_reaches_the_jobs_that_read_it_and_no_others(key, value, reads):
    before, after = slices(tiny_study()), slices(changed(tiny_study(), key, value))
    assert before.keys() == after.keys()
    changed_jobs = reached(before, after)
    assert changed_jobs - {("report_page",)} == {job for job in before if reads(job)} != set()
    assert ("report_page",) in changed_jobs  # it shows the whole configuration


def test_captures_of_a_study_of_restored_captures_alone():
    """Images are chosen by the answers that this study has."""
    chosen = CapturesJob.of(parse(tiny_study() | {"tables": ["table4"]})).chosen_by
    assert chosen[SHARP] == "small" and chosen["singlet-imaging1"] == "small-restored"
    assert set(CapturesJob.of(parse(tiny_study())).chosen_by.values()) == {"small"}


def test_diffraction_changes_no_design():
    """It changes the PSFs of every lens; training, restoration and measurement use these."""
    study = parse(changed(tiny_study(), "capture", {"diffraction": True}))
    before, after = slices(tiny_study()), slices(changed(tiny_study(), "capture", {"diffraction": True}))
    assert all(after[job] == before[job] for job in before if job[0] == "design")
    assert {job for job in reached(before, after) if job[0] == "psfs"} == {
        ("psfs", lens) for lens in [*study.lenses, *study.variants]
    }
    psf = lens_file("tiny", "singlet-imaging1", name="psf.safetensors")
    for rule, wildcards in (("fine_tune", {"measured_name": "small"}), ("restore", {})):
        assert psf in job_of(rule, study, lens="singlet-imaging1", seed=0, **wildcards).reads
    with pytest.raises(StudyError, match="tolerances: built lenses have no diffraction"):
        job_of("production", study, lens="singlet-imaging1", seed=0)


def test_a_network_of_another_seed(here):
    """It has other weights."""
    weights = []
    finish("images", parse(tiny_study()))
    for seed in (0, 0, 1):
        study = parse(changed(tiny_study(), "classifiers.small.seed", seed))
        weights.append(load_file(finish("reference", study, classifier="small").weights))
    first, same, other = weights
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not any(torch.equal(first[name], other[name]) for name in first if name.endswith("conv1.weight"))


def test_editing_a_plastic_redesigns_the_lenses_that_use_it_and_no_others():
    study = one_lens(elements={"doublet": ["OKP4", "MINE"], "singlet": ["COC"]}, tables=["table1"])
    plastic = builtin("COC").definition()
    before = slices(study | {"materials": {"MINE": plastic}})
    after = slices(study | {"materials": {"MINE": plastic | {"coefficients": [2.31, 0.01, 0.037, 0, 0, 0]}}})
    changed_jobs = reached(before, after) - {("report_page",)}
    assert changed_jobs == {job for job in before if job[0] == "design" and job[1].startswith("doublet")}


def test_a_study_may_make_some_of_the_tables():
    """Tails, verdicts and verification cover only the lenses and measurements of these tables."""
    mapping = changed(tiny_study(), "tables", ["table3"])
    before, after = slices(tiny_study()), slices(mapping)
    expected = {(f"{name}_table",) for name in ("psf_tail", "merit_function", "verdicts")}
    expected |= {("verify",), ("captures",), ("report_page",)}
    assert reached(before, after) == expected
    study = parse(mapping)
    verified = table_contents.verification(study)
    assert table_contents.table_lenses(study) == verified.lenses == CLASSIFIED
    assert {classifier for _, classifier in verified.measured} == {"small"}
    assert {claim.table for claim in claims.claims(study).claims} == {"table3"}
    assert {claim.table for claim in claims.claims(parse(tiny_study())).claims} == {*TABLES}


def test_an_imported_lens_adds_rows_and_changes_no_other_job():
    """It is listed last among imaging designs; nothing starts from it. The network sets its focus."""
    before, after = slices(tiny_study()), slices(with_imported())
    rows = {("table", name) for name in ("table1", "table2", "table4")}
    tables_of_all = [f"{name}_table" for name in ("psf_tail", "effort", "merit_function", "ranking", "tolerances")]
    tables_of_all += ["captures", "verify"]
    rows |= {(rule,) for rule in (*tables_of_all, "report_page")}
    assert reached(before, after) == rows
    assert all("quadruplet-phone" in job for job in after.keys() - before.keys())
    study = parse(with_imported())
    assert [table_contents.table(study, name).lenses[-1] == "quadruplet-phone" for name in TABLES] == [
        True,
        True,
        False,
        True,
    ]
    assert table_contents.lens_design(study, "quadruplet-phone", 0).classifier == study.classifier(study.supervisor)
    as_in_file = parse(changed(with_imported(), "imported.phone.focus", "file"))
    assert table_contents.lens_design(as_in_file, "quadruplet-phone", 0).classifier is None
    assert job_of("design", as_in_file, lens="quadruplet-phone", seed=0).reads == [study.imported["phone"].file]
    assert table_contents.starts(study, "quadruplet-phone") == ()
    assert not any("phone" in str(path) for path in job_of("design", study, lens=SUPERVISED[1], seed=0).reads)


def test_a_specification_of_its_own_changes_the_lenses_of_these_elements_alone():
    """Designs, PSFs, tails and verified focal lengths of doublets change; these are then no baselines of singlets."""
    designs = {name: tiny_study()["designs"][name] for name in ("tasklens", "imaging1")}
    study = tiny_study() | {"designs": designs, "elements": {"singlet": ["COC"], "doublet": ["COC", "OKP4"]}}
    before, after = slices(study), slices(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    changed_jobs = reached(before, after)
    of_a_lens = "design", "psfs", "production"
    doublets = {job for job in before if job[0] in of_a_lens and job[1].startswith("doublet")}
    assert changed_jobs == doublets | {("psf_tail_table",), ("verdicts_table",), ("verify",), ("report_page",)}
    both = parse(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    efl_mm = table_contents.verification(both).efl_mm
    assert efl_mm["singlet-imaging1"] == both.spec.efl_mm < efl_mm["doublet-imaging1"]
    assert parse(yaml.safe_load(dump(both))) == both
