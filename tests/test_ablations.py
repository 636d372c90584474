"""Ablations: variants of a design, which jobs they change, and the table that compares them."""

import json

import pandas
import pytest
import yaml
from rules import finish, job_of, outputs, reached, slices
from studies import changed, tiny_study
from study_results import write_results

from tasklens.settings.capture_settings import CaptureSettings, SensorSettings
from tasklens.study import claims
from tasklens.study.loading import dump, parse
from tasklens.study.report.verdicts import HOLDS
from tasklens.study.study import StudyError

FINE = {"descents": {"0": {"pixels": [1, 1]}}}  # the first descent, changed
RAYS = {"elements": "singlet", "design": "tasklens", "variants": {"few": {"rays": 8} | FINE}}
WINDOW = RAYS | {"variants": {"renormalised": {"capture": {"outside_window": "renormalise"}}}}


def with_ablation(ablation: dict) -> dict:
    return changed(tiny_study(), "ablations.mine", ablation)


def test_a_variant_is_its_design_changed_in_what_it_names():
    """Nested keys change too, and nothing else does; a variant is in no table of the paper."""
    study = parse(with_ablation(RAYS))
    base, variant = study.lens("singlet-tasklens"), study.lens("singlet-tasklens_mine_few")
    first, *others = base.design.descents
    assert variant.design.rays == 8 and variant.design.descents[0].pixels == (1, 1) != first.pixels
    descents = (first.model_copy(update={"pixels": (1, 1)}), *others)
    assert variant.design == base.design.model_copy(update={"rays": 8, "descents": descents})
    assert variant.plastics == base.plastics
    assert study.lenses == parse(tiny_study()).lenses
    assert parse(yaml.safe_load(dump(study))) == study


def test_a_variant_of_the_capture_is_designed_and_measured_with_it():
    study = parse(with_ablation(WINDOW))
    lens = "singlet-tasklens_mine_renormalised"
    renormalised = CaptureSettings(outside_window="renormalise")

    def capture(rule: str, lens: str, **wildcards: str) -> CaptureSettings:
        settings = json.loads(job_of(rule, study, lens=lens, seed=0, **wildcards).settings)
        return CaptureSettings.model_validate(settings["capture"])

    assert capture("design", lens) == capture("restore", lens) == renormalised
    assert all(capture(rule, lens, measured_name="small") == renormalised for rule in ("fine_tune", "reproduce"))
    assert capture("design", "singlet-tasklens") == study.capture != renormalised


def test_a_variant_of_the_capture_keeps_what_it_does_not_name():
    """Of a sensor, too, only the named key changes."""
    study = changed(tiny_study(), "capture", {"colour": "linear", "sensor": {"full_well": 800}})
    ablation = RAYS | {"variants": {"dark": {"capture": {"sensor": {"gain": 16}}}}}
    entry = parse(changed(study, "ablations.mine", ablation)).variant("mine", "dark")
    assert entry.capture == CaptureSettings(colour="linear", sensor=SensorSettings(full_well=800, gain=16))


def test_an_ablation_changes_its_own_jobs_and_no_others():
    """A new ablation adds jobs; another ray count redesigns the variant; the report covers the whole study."""
    variant = "singlet-tasklens_mine_few"
    before, after = slices(tiny_study()), slices(with_ablation(RAYS))
    assert reached(before, after) == {("report_page",)}
    assert all(variant in job or job == ("ablation", "mine") for job in after.keys() - before.keys())
    rays = slices(with_ablation(RAYS | {"variants": {"few": {"rays": 9} | FINE}}))
    assert reached(after, rays) == {("design", variant), ("report_page",)}


def test_a_capture_that_a_design_does_not_see_redesigns_nothing():
    spot = RAYS | {"design": "imaging1"}
    lens = {"lens": "singlet-imaging1_mine_few", "seed": 0}
    veil, renormalised = (
        parse(with_ablation(spot | {"variants": {"few": {"rays": 8, "capture": {"outside_window": window}}}}))
        for window in ("veil", "renormalise")
    )
    for rule, others, is_changed in (("fine_tune", {"measured_name": "small"}, True), ("design", {}, False)):
        settings = [job_of(rule, study, **lens, **others).settings for study in (veil, renormalised)]
        assert (settings[0] != settings[1]) == is_changed


def test_variants_of_a_search_that_ends_at_a_spot_are_compared():
    """The spot of these elements counts, also if it is given by elements."""
    spots = {"design": "imaging2", "variants": {"same": {"spot_um": 5}}}
    study = changed(with_ablation(RAYS | spots), "designs.imaging2.spot_um", {"singlet": 5})
    with pytest.raises(StudyError, match=r"variants\.same: has the same values as the design itself"):
        parse(study)
    variant = parse(changed(study, "ablations.mine.variants.same.spot_um", 6)).variant("mine", "same")
    assert variant.design.spot_um == 6
    by_elements = parse(changed(study, "ablations.mine.variants.same.spot_um", {"singlet": 7}))
    assert by_elements.variant("mine", "same").design.spot_um == 7
    with pytest.raises(StudyError, match=r"variants\.same\.spot_um: expected a value for singlet"):
        parse(changed(study, "ablations.mine.variants.same.spot_um", {"doublet": 7}))


def test_names_that_another_design_has_are_refused():
    study = with_ablation(RAYS)
    same = changed(study, "designs.tasklens_mine_few", study["designs"]["imaging1"])
    twice = {"mine": RAYS | {"variants": {"a_b": {"rays": 8}}}, "mine_a": RAYS | {"variants": {"b": {"rays": 9}}}}
    for wrong, words in ((same, "tasklens_mine_few"), (tiny_study() | {"ablations": twice}, "tasklens_mine_a_b")):
        with pytest.raises(StudyError, match=rf"{words}.*rename"):
            parse(wrong)


def test_table_of_an_ablation(here):
    """The design is first, then its variants with their gains."""
    study = parse(changed(with_ablation(RAYS), "seeds", [0, 1, 2, 3, 4]))
    base, variant = "singlet-tasklens", "singlet-tasklens_mine_few"
    compared = claims.ablation_claims(study, "mine")
    assert [(claim.lens, claim.baselines) for claim in compared.claims] == [(variant, (base,))]
    lenses = {base: 0.5, variant: 0.8}
    write_results(study, lambda lens, *_: lenses[lens], lenses=lenses)
    worst = outputs("design", study, lens=variant, seed=4).lens
    content = yaml.safe_load(worst.read_text())
    content["worst_margin"]["value"] = -0.2  # the worst margin counts even if only one seed of five has it
    worst.write_text(yaml.safe_dump(content))
    job = finish("ablation", study, ablation="mine")
    rows = pandas.read_csv(job.csv).set_index("lens")
    assert list(rows.index) == list(lenses)
    first, other = (rows.loc[lens] for lens in lenses)
    assert pandas.isna(first["difference"]) and other["verdict"].startswith(HOLDS)
    assert other["difference"] == pytest.approx(30, abs=3)
    assert other["low"] < other["difference"] < other["high"]
    assert other["rms_spot_um"] == 9.0 and other["worst_margin"] == -0.2
    assert first["worst_margin"] == 0.01
    text = job.md.read_text()
    assert variant in text and f"{other['difference']:+.1f}" in text and "nan" not in text
