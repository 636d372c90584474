"""The workflow in other workflows, from other folders, and several studies in one run."""

import re
import shutil
from pathlib import Path

import pytest
import yaml
from rules import ROOT, finish
from studies import one_lens
from workflows import forked, plan, snakemake

from tasklens.settings.names import SHARP
from tasklens.study.loading import parse

ONE_LENS = one_lens(tables=["table1"])


@pytest.fixture(scope="module")
def reference_results(tmp_path_factory):
    """Images, the reference classifier and its metrics on sharp images, from jobs in this process."""
    folder, study = tmp_path_factory.mktemp("reference"), parse(ONE_LENS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        finish("images", study)
        finish("reference", study, classifier="small")
        finish("fine_tune", study, lens=SHARP, measured_name="small", seed=0)
    return folder / "results"


@pytest.mark.slow
def test_another_workflow_uses_ours_as_a_module(tmp_path, reference_results):
    """The workflow of the how-to runs the jobs of the lens and of the table, in Snakemake's own words."""
    page = (ROOT / "docs" / "how-to.md").read_text()
    (text,) = re.findall(r"```text\n(import yaml\n.*?)```", page, re.DOTALL)
    (tmp_path / "Snakefile").write_text(text.replace("TaskLens/Snakefile", f"{ROOT}/Snakefile"))
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(ONE_LENS))
    shutil.copytree(reference_results, tmp_path / "results")
    options = ("--snakefile", "Snakefile", "--directory", ".", "copy")
    result = snakemake(tmp_path, None, *options)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "copy.csv").read_bytes() == (tmp_path / "results/tiny/tables/table1.csv").read_bytes()
    assert "rule lens_design:" in result.stderr and "Study tiny" not in result.stdout
    assert "Nothing to be done" in forked(tmp_path, None, *options)[1]


@pytest.mark.slow
def test_studies_by_their_names_in_one_run(tmp_path):
    """Studies of the local `config` folder and of the package; the configuration changes only its own study."""
    (tmp_path / "config").mkdir()
    (tmp_path / "config/tiny.yaml").write_text(yaml.safe_dump(ONE_LENS))
    (tmp_path / "config/tiny2.yaml").write_text("{name: tiny2, extends: tiny, seeds: [0, 1]}")
    targets = ["results/tiny/report.html", "results/tiny2/tables/table1.csv", "results/smoke/images/train.npy"]
    jobs = plan(tmp_path, None, *targets, "--config", "seeds=[4]")
    assert jobs["design"] == 3 and jobs["images"] == 3 and jobs["fine_tune"] == 2 * 3
    assert [jobs[rule] for rule in ("report_page", "captures", "verdicts_table")] == [1, 1, 1]  # of tiny
    assert plan(tmp_path, None, "table1", "--config", "study=tiny2", "seeds=[4, 5, 6]")["design"] == 3
    (tmp_path / "config/other.yaml").write_text("{name: another, extends: tiny}")
    unknown = "results/tiny/lenses/singlet-nobody/seed0/lens.yaml"
    for study, options, words in [
        (None, ["--config", "study=absent"], "absent.yaml: no such study"),
        (None, ["results/other/report.html"], "name = another: expected other"),
        (ONE_LENS, ["--config", "study=tiny"], "expected one of them"),
        (None, ["results/absent/report.html"], "absent.yaml: no such study"),
        (None, [unknown], "unknown lens 'singlet-nobody'; expected one of singlet-imaging1"),
    ]:
        status, output = forked(tmp_path, study, "--dry-run", *options)
        assert status != 0 and words in output and ("Traceback" not in output or "--config" not in options)


def test_a_study_that_we_ship_is_planned_elsewhere(tmp_path):
    """Its imported lenses are those beside our Snakefile."""
    weights = tmp_path / "data/mobilenetv2_100_same_in1k.safetensors"
    weights.parent.mkdir()
    weights.touch()
    lens = "results/photographs_triplets/lenses/triplet-phone_3p/seed0/lens.yaml"
    jobs = {"design": 1, "images": 1, "reference": 1}  # the network sets the focus
    assert plan(tmp_path, [ROOT / "config" / "photographs_triplets.yaml"], lens) == jobs
    assert not Path(tmp_path, "results").exists()
