"""`tasklens study ...` except `new` as a user types it: output and files of each command, and its error messages."""

import json

import pytest
from examples import write
from studies import one_lens
from study_command import complaint, study

from tasklens.study.loading import dump, parse

pytestmark = pytest.mark.usefixtures("here")


def test_a_plan_counts_jobs_time_memory_and_disk(here, capsys):
    """Of a study without results; the command writes nothing.

    The first page, of the singlets, is a part of a study of two element counts: its tables are two more jobs.
    """
    elements = {"singlet": ["COC"], "doublet": ["COC", "OKP4"]}
    write("study.yaml", dump(parse(one_lens(elements=elements, tables=["table1"]))))
    assert study("plan", "study.yaml", "--json") == 0
    (plan,) = json.loads(capsys.readouterr().out)["points"]
    counts = {stage: len(jobs["missing"]) for stage, jobs in plan["jobs"].items()}
    expected = {"images": 1, "reference": 1, "design": 2, "psfs": 2, "fine_tune": 3, "table": 2, "report_page": 2}
    assert plan["study"] == "tiny" and expected.items() <= counts.items()
    assert {*plan["jobs"]["design"]["missing"]} == {f"design/{name}-imaging1-seed0" for name in elements}
    assert plan["seconds"] > 0 and plan["memory_mb"] >= 1000 and plan["changed"] == []
    assert plan["disk_mb"] == pytest.approx(70 * 3 * 16**2 / 1e6)
    assert not (here / "results").exists()


def test_other_targets_than_tables(capsys):
    """Without jobs, and of another study."""
    write("study.yaml", dump(parse(one_lens())))
    assert study("plan", "study.yaml", "--target", "ablations") == 0
    assert "tiny: nothing to do for ablations." in capsys.readouterr().out
    why = complaint(capsys, "plan", "study.yaml", "--target", "results/smoke/images/train.npy")
    assert "has jobs of the study smoke, not tiny" in why


@pytest.mark.parametrize("command, replacement", [("diff", "diff -u"), ("export", "tar -czf")])
def test_a_removed_command_names_its_replacement(capsys, command, replacement):
    assert replacement in complaint(capsys, command, "results/tiny", "--all")
