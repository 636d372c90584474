"""A study decides the claims that its lenses, tables and restorations allow."""

import pandas
import yaml
from rules import finish
from studies import tiny_study
from study_results import DOUBLET, study_of

from tasklens.study import claims, table_contents
from tasklens.study.claims import FEWER_ELEMENTS, OVER_END_TO_END, OVER_IMAGE_QUALITY, OVER_IMAGING1, OVER_LEAST_SQUARES
from tasklens.study.loading import dump, parse
from tasklens.study.report import verdicts


def test_claims_of_each_table():
    """Tables 1 and 4 of the supervisor, 2 of the other classifiers, table 3 about end-to-end design."""
    job = claims.claims(study_of(1))
    by_claim = {(c.table, c.text, c.lens, c.classifier): c.baselines for c in job.claims}
    assert len(by_claim) == len(job.claims)
    squares = ("doublet-imaging2", "doublet-imaging3")
    triplets = ("triplet-image_error", *(f"triplet-imaging{k}" for k in (1, 2, 3)))
    for table, classifier in (("table1", "small"), ("table2", "other"), ("table4", "small-restored")):
        mine = {key[1:]: baselines for key, baselines in by_claim.items() if key[0] == table}
        assert len(mine) == 7 and (FEWER_ELEMENTS, "triplet-tasklens", classifier) not in mine
        assert mine[OVER_IMAGING1, "doublet-tasklens", classifier] == ("doublet-imaging1",)
        assert mine[OVER_LEAST_SQUARES, "doublet-tasklens", classifier] == squares
        assert mine[OVER_IMAGE_QUALITY, "doublet-tasklens", classifier] == ("doublet-image_error",)
        assert mine[FEWER_ELEMENTS, "doublet-tasklens", classifier] == triplets
    assert {key[1:]: baselines for key, baselines in by_claim.items() if key[0] == "table3"} == {
        (OVER_END_TO_END, "doublet-tasklens", "small"): ("doublet-end_to_end_from_imaging",),
        (claims.FLAT_FAILS, "doublet-end_to_end_from_flat", "small"): (),
        (OVER_END_TO_END, "triplet-tasklens", "small"): ("triplet-end_to_end_from_imaging",),
        (claims.FLAT_FAILS, "triplet-end_to_end_from_flat", "small"): (),
    }
    alone = claims.claims(parse(yaml.safe_load(dump(study_of(1))) | {"tables": ["table2"]})).claims
    assert {c.classifier for c in alone} == {"small", "other"}  # if no table 1 has the supervisor's claims


def test_claims_after_restoration_are_about_what_is_restored():
    """Table 4 compares doublets with doublets only; the claims of other tables stay."""
    study = study_of(1)
    only = parse(yaml.safe_load(dump(study)) | {"restored": ["doublet"]})
    assert {lens.partition("-")[0] for lens in table_contents.table(only, "table4").lenses} == {"doublet"}
    doublet_claims, all_claims = claims.claims(only).claims, claims.claims(study).claims
    assert [c for c in doublet_claims if c.table != "table4"] == [c for c in all_claims if c.table != "table4"]
    restored = [c for c in doublet_claims if c.table == "table4"]
    assert {c.text for c in restored} == {OVER_IMAGING1, OVER_LEAST_SQUARES, OVER_IMAGE_QUALITY}
    assert {name.partition("-")[0] for c in restored for name in (c.lens, *c.baselines)} == {"doublet"}


def test_fewer_elements_are_judged_between_neighbours_in_the_study():
    """Without a triplet, a doublet is compared with quadruplets; other plastics are not another number of elements."""
    others = {"other": DOUBLET[::-1], "quadruplet": 2 * DOUBLET, "singlet": ["COC"]}
    job = claims.claims(study_of(1, doublet=DOUBLET, **others))
    baselines = {c.lens: {r.partition("-")[0] for r in c.baselines} for c in job.claims if c.text == FEWER_ELEMENTS}
    assert baselines == {
        "singlet-tasklens": {"doublet", "other"},
        "doublet-tasklens": {"quadruplet"},
        "other-tasklens": {"quadruplet"},
    }


def test_claims_about_absent_lenses_are_left_out(here):
    """A study without task-driven or end-to-end lenses has no claim, and its file says so."""
    designs = {name: design for name, design in tiny_study()["designs"].items() if name.startswith("imaging")}
    study = parse(tiny_study() | {"designs": designs})
    job = claims.claims(study)
    assert job.claims == ()
    paths = finish("verdicts_table", study)
    assert list(pandas.read_csv(paths.csv)) == verdicts.COLUMNS
    assert "Study `tiny` has no lenses that the paper's claims are about" in paths.md.read_text()


def test_lenses_of_other_specifications_are_no_baselines():
    """A faster triplet is no baseline with more elements for a doublet; in the map, each has its own elements."""
    study = study_of(1, doublet=DOUBLET, triplet_f2=[*DOUBLET, "COC"])
    assert any(claim.text == claims.FEWER_ELEMENTS for claim in claims.claims(study).claims)
    faster = study.model_copy(update={"specs": {"triplet_f2": {"f_number": 2.0}}})
    assert not any(claim.text == claims.FEWER_ELEMENTS for claim in claims.claims(faster).claims)
    by_elements = claims.claims_by_elements(faster)
    assert {name: [(c.lens, c.baselines) for c in of_elements] for name, of_elements in by_elements.items()} == {
        name: [(f"{name}-tasklens", (f"{name}-image_error", *(f"{name}-imaging{k}" for k in (1, 2, 3))))]
        for name in ("doublet", "triplet_f2")
    }
