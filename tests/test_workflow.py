"""The study as a workflow: what a dry run plans, and what stops a study before its first job."""

import json
import re
from collections.abc import Iterator

import pytest
import rules
import yaml
from rules import ROOT, every_job, wildcards_of
from studies import changed, studies_we_ship, tiny_study
from workflows import forked, plan, smoke_with_imported

from tasklens.study import table_contents
from tasklens.study.loading import at_points, load, parse
from tasklens.study.study import Study

STUDIES = studies_we_ship()
PAGE_JOBS = ("psf_tail_table", "effort_table", "captures", "report_page")


@pytest.fixture
def beside_config(tmp_path):
    """A folder from which the studies that we ship are in `config/`."""
    (tmp_path / "config").symlink_to(ROOT / "config")
    return tmp_path


def test_the_default_study_plans_its_jobs(beside_config):
    """All that can be asked for of a file alone: 24 lenses, 8 variants, and pages of two early parts."""
    targets = ["tables", "verify", "figures", "certificates", "figure3", "figure4", "ablations"]
    jobs = {"images": 1, "reference": 4, "design": 32, "psfs": 32, "restore": 6, "fine_tune": 96, "reproduce": 88}
    jobs |= {"table": 6, "verdicts_table": 3, "ablation": 6, "certificate": 24, "drawing": 24}
    jobs |= {"comparison": 3, "frames": 3} | dict.fromkeys(PAGE_JOBS, 3)
    assert plan(beside_config, None, *targets) == jobs


def test_a_sweep_plans_the_jobs_of_its_points(beside_config):
    """Of a study that extends a sweep, which extends another study: two points; `--config` is laid over its file."""
    sweep = {"images.seed": [26, 27]}
    jobs = {"images": 2, "reference": 2, "design": 26, "psfs": 26, "fine_tune": 28, "certificate": 26}
    jobs |= {"table": 2, "verdicts_table": 2, "sweep_table": 1} | dict.fromkeys(PAGE_JOBS, 2)
    planned = plan(beside_config, [STUDIES["indoors.yaml"]], "tables", "--config", f"sweep={json.dumps(sweep)}")
    assert planned == jobs


def one_of_each_kind(rule: str, study: Study) -> Iterator[dict]:
    """The wildcards of a rule, without repetitions for other elements and classifiers; each design is designed."""
    kinds = set()
    for wildcards in wildcards_of(rule, study):
        design = wildcards["lens"].partition("-")[2] if rule in ("design", "fine_tune") else ""
        restored = "-restored" in wildcards.get("measured_name", "")
        kind = (design, restored, wildcards.get("table"), wildcards.get("ablation"), wildcards.get("task"))
        if kind not in kinds:
            kinds.add(kind)
            yield wildcards


PLANNED = ("config.yaml", "indoors.yaml", "replication.yaml", "fresh.yaml", "doublets.yaml")  # or extended by indoors


@pytest.mark.parametrize("name", [name for name in STUDIES if name not in PLANNED])
def test_every_kind_of_job_of_a_study_has_its_settings(name, monkeypatch):
    """Of the first seed, and the first point of a sweep. A dry run plans the same kinds of jobs (above)."""
    monkeypatch.setattr(rules, "wildcards_of", one_of_each_kind)
    point = at_points(load(STUDIES[name]))[0]
    first = point.model_copy(update={"seeds": point.seeds[:1]})
    assert {"design", "fine_tune", "table"} <= {key[0] for key, _ in every_job(first)}


def test_without_a_target_the_tables_are_made(tmp_path):
    """Snakemake forgets the default target of an included file."""
    study = tiny_study()
    del study["classifiers"]["other"]
    jobs = {"images": 1, "reference": 1, "design": 6, "psfs": 6, "restore": 4, "fine_tune": 11, "certificate": 6}
    jobs |= {"table": 4, "verdicts_table": 1, "tables": 1} | dict.fromkeys(PAGE_JOBS, 1)
    assert plan(tmp_path, study) == jobs


def test_tables_without_lenses_are_left_out(tmp_path):
    """Least squares alone has no rows in the table of end-to-end designs."""
    study = tiny_study() | {"designs": {"imaging2": {"method": "least_squares"}}}
    del study["classifiers"]["other"]
    count = plan(tmp_path, study, "tables")["table"]
    assert 0 < count == len(table_contents.tables(parse(study))) < len(parse(study).tables)
    status, output = forked(tmp_path, study, "--dry-run", "table3")
    assert status != 0 and "table3: the study has no lens for this table; add a design" in output


@pytest.mark.parametrize("options, gpus", [((), "gpu=1"), (("--config", "gpus=false"), "gpu=0")])
def test_a_cluster_without_gpus_is_asked_for_none(tmp_path, options, gpus):
    status, output = forked(tmp_path, tiny_study(), "--dry-run", "table1", *options)
    asked = re.findall(r"rule reference:(?:.|\n)*?(gpu=\d)", output)
    assert status == 0 and set(asked) == {gpus}


def test_a_flag_is_true_or_false(tmp_path):
    status, output = forked(tmp_path, tiny_study(), "--dry-run", "table1", "--config", "overwrite=maybe")
    assert status != 0 and "overwrite=maybe: expected true or false" in output


def test_a_target_of_an_unknown_ablation_names_those_of_the_study(tmp_path):
    """A study without ablations says what to do."""
    rays = {"elements": "singlet", "design": "tasklens", "variants": {"few": {"rays": 8}}}
    study = tiny_study() | {"ablations": {"rays": rays, "more": rays | {"variants": {"many": {"rays": 32}}}}}
    for content, target, words in (
        (study, "ablation_x", "ablation_x: tiny has no such ablation; expected ablation_more, ablation_rays"),
        (tiny_study(), "ablation_rays", "ablation_rays: tiny has no such ablation; add it to `ablations`"),
    ):
        status, output = forked(tmp_path, content, "--dry-run", target)
        assert status != 0 and words in output


def test_table_1_alone_takes_the_lenses_of_table_1_alone(tmp_path):
    """Four lenses, not all six: nothing else waits for those of end-to-end design."""
    jobs = {"images": 1, "reference": 1, "table": 1, "verdicts_table": 1, "design": 4, "psfs": 4, "fine_tune": 5}
    study = tiny_study() | {"tables": ["table1"]}
    assert plan(tmp_path, study, "verify") == jobs | {"reproduce": 5}
    assert plan(tmp_path, study, "tables") == jobs | {"certificate": 4} | dict.fromkeys(PAGE_JOBS, 1)


def test_a_mistake_in_the_study_stops_before_any_job(tmp_path):
    entry = {"elements": "quadruplet", "file": "no/phone.zmx"}
    study = changed(changed(tiny_study(), "spec.kernle", 51), "imported.phone", entry)
    status, message = forked(tmp_path, study, "table1")
    assert status != 0 and "Traceback" not in message
    assert "spec.kernle = 51" in message and "imported.phone.file = 'no/phone.zmx'" in message
    assert not (tmp_path / "results").exists()


# ---- an imported lens


def test_an_imported_lens_joins_the_tables(here):
    """In a study of two seeds."""
    study = smoke_with_imported(here) | {"seeds": [3, 4]}
    jobs = {"images": 1, "reference": 2, "design": 12, "psfs": 12, "restore": 8, "fine_tune": 32, "certificate": 6}
    jobs |= {"table": 4, "verdicts_table": 1} | dict.fromkeys(PAGE_JOBS, 1)
    assert plan(here, study, "tables") == jobs


@pytest.mark.parametrize("profile", ["default", "slurm"])
def test_a_profile_retries_failed_jobs(profile):
    """Memory and time double at the second attempt."""
    settings = yaml.safe_load((ROOT / "profiles" / profile / "config.yaml").read_text())
    assert settings["retries"] == 1 and settings["rerun-incomplete"]
