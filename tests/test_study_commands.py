"""`tasklens study ...` except `new` as a user types it: output and files of each command, and its error messages."""

import json

import pytest
from examples import changed, one_lens, tiny_study, write
from study_command import complaint, study

from tasklens.study.loading import dump, parse


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ---- check, plan


def test_check_finds_a_wrong_folder(place, capsys):
    images = {"size": 16, "minival": 2, "folder": str(place / "photos")}
    write("study.yaml", dump(parse(changed(tiny_study(), "images", images))))
    assert "photos: no such folder" in complaint(capsys, "check", "--no-weight-files", "study.yaml")


def test_a_plan_counts_jobs_time_memory_and_disk(place, capsys):
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
    assert not (place / "results").exists()


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


# ---- bad places


@pytest.mark.parametrize("command", ["status", "plan"])
@pytest.mark.parametrize(
    "bad, words",
    [
        ("absent", "absent: no such file"),
        ("folder", "folder: "),
        ("broken.yaml", "broken.yaml, line 1, column 5: not valid YAML"),
        ("part.yaml", "part.yaml: has no format, name, images"),
    ],
)
def test_a_file_that_is_no_study_is_reported(place, capsys, command, bad, words):
    """By `check`, too: test_bad_inputs has more of these."""
    (place / "folder").mkdir()
    write("broken.yaml", "a: [")
    write("part.yaml", "seeds: [1]\n")
    assert words in complaint(capsys, command, bad)
