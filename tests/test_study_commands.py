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


def test_check_finds_a_wrong_folder_and_missing_weights(place, capsys):
    write("study.yaml", dump(parse(tiny_study())))
    assert "classifiers.other.weights = /nowhere: no such file" in complaint(capsys, "check", "study.yaml")
    images = {"size": 16, "minival": 2, "folder": str(place / "photos")}
    write("study.yaml", dump(parse(changed(tiny_study(), "images", images))))
    assert "photos: no such folder" in complaint(capsys, "check", "--no-weight-files", "study.yaml")


def test_a_plan_counts_jobs_time_memory_and_disk(place, capsys):
    """A plan of a study without results, 1 singlet of the tiny study in table 1; the command writes nothing."""
    write("study.yaml", dump(parse(one_lens())))
    assert study("plan", "study.yaml", "--target", "table1", "--json") == 0
    (plan,) = json.loads(capsys.readouterr().out)["points"]
    counts = {stage: len(jobs["missing"]) for stage, jobs in plan["jobs"].items()}
    assert counts == {"images": 1, "reference": 1, "design": 1, "psfs": 1, "fine_tune": 2, "table": 1}
    assert plan["jobs"]["design"]["missing"] == ["design/singlet-imaging1-seed0"]
    assert plan["seconds"] > 0 and plan["memory_mb"] >= 1000 and plan["changed"] == []
    assert plan["disk_mb"] == pytest.approx(70 * 3 * 16**2 / 1e6)
    assert not (place / "results").exists()


def test_a_plan_of_a_study_with_parts_counts_their_jobs(capsys):
    """The first page, of the singlets, is a part of a study of two element counts: its tables are two more jobs."""
    elements = {"singlet": ["COC"], "doublet": ["COC", "OKP4"]}
    write("study.yaml", dump(parse(one_lens(elements=elements, tables=["table1"]))))
    assert study("plan", "study.yaml", "--json") == 0
    (plan,) = json.loads(capsys.readouterr().out)["points"]
    counts = {stage: len(jobs["missing"]) for stage, jobs in plan["jobs"].items()}
    assert plan["study"] == "tiny" and counts["table"] == counts["report_page"] == 2 and counts["design"] == 2


def test_other_targets_than_tables(capsys):
    """Without jobs, of another study, and unknown."""
    write("study.yaml", dump(parse(one_lens())))
    assert study("plan", "study.yaml", "--target", "ablations") == 0
    assert "tiny: nothing to do for ablations." in capsys.readouterr().out
    why = complaint(capsys, "plan", "study.yaml", "--target", "results/smoke/images/train.npy")
    assert "has jobs of the study smoke, not tiny" in why
    why = complaint(capsys, "plan", "study.yaml", "--target", "nothing")
    assert "cannot plan nothing of study.yaml" in why and "No rule to produce nothing" in why


@pytest.mark.parametrize("command, replacement", [("diff", "diff -u"), ("export", "tar -czf")])
def test_a_removed_command_names_its_replacement(capsys, command, replacement):
    assert replacement in complaint(capsys, command, "results/tiny", "--all")


# ---- bad places


@pytest.mark.parametrize("command", ["status", "check", "plan"])
@pytest.mark.parametrize(
    "bad, words",
    [
        ("absent", "absent: no such file"),
        ("folder", "folder: "),
        ("broken.yaml", "broken.yaml, line 1, column 5: not valid YAML"),
        ("binary.yaml", "binary.yaml, line 1: not valid YAML: the text is not UTF-8"),
        ("list.yaml", "list.yaml: expected keys and values"),
        ("part.yaml", "part.yaml: has no format, name, images"),
    ],
)
def test_a_file_that_is_no_study_is_reported(place, capsys, command, bad, words):
    (place / "folder").mkdir()
    write("broken.yaml", "a: [")
    (place / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    write("list.yaml", "- 1\n")
    write("part.yaml", "seeds: [1]\n")
    assert words in complaint(capsys, command, bad)


def test_a_study_without_results_is_reported(place, capsys):
    write("study.yaml", dump(parse(tiny_study())))
    assert "no run of this study" in complaint(capsys, "status", "study.yaml")
