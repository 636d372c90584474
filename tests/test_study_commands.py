"""`tasklens study ...` except `new` as a user types it: output and files of each command, and its error messages."""

import json
import zipfile
from pathlib import Path

import pytest
from examples import changed, tiny_study, write
from study_command import complaint, study

from tasklens.study.loading import dump, load, parse

TABLE = "elements,design,accuracy,rms_spot_um,accuracy_paper\n,reference,80,,75\nsinglet,imaging1,{},{},60\n"


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def results(place):
    """Results of two runs: `tiny`, and `tiny_2` with a faster and worse lens."""
    for name, f_number, numbers in (("tiny", 2.8, (60, 4)), ("tiny_2", 2.0, (55.5, 9))):
        folder = f"results/{name}"
        study = changed(tiny_study() | {"name": name}, "spec.f_number", f_number)
        write(f"{folder}/study.yaml", dump(parse(study)))
        write(f"{folder}/tables/table1.csv", TABLE.format(*numbers))
        for path in ("lenses/a/seed0/lens.yaml", "metrics/a.csv", "logs/images.log", "benchmarks/images.tsv"):
            write(f"{folder}/{path}", path)
        for path in ("images/train.npy", "checkpoints/design-a.pt", "progress/design/a.json", "lenses/.half.part"):
            write(f"{folder}/{path}", path)
        write(f"{folder}/classifiers/reference/small.safetensors", "weights")
        write(f"{folder}/restoration/a/nafnet.safetensors", "weights")
        write(f"{folder}/tasks/reference/pixels.safetensors", "weights")
    return place / "results"


# ---- check, plan


def test_check_finds_a_wrong_folder_and_missing_weights(place, capsys):
    write("study.yaml", dump(parse(tiny_study())))
    assert "classifiers.other.weights = /nowhere: no such file" in complaint(capsys, "check", "study.yaml")
    images = {"size": 16, "minival": 2, "folder": str(place / "photos")}
    write("study.yaml", dump(parse(changed(tiny_study(), "images", images))))
    assert "photos: no such folder" in complaint(capsys, "check", "--no-weight-files", "study.yaml")


def test_a_plan_counts_jobs_time_memory_and_disk(place, capsys):
    """A plan of a study without results, 1 singlet of the tiny study in table 1; the command writes nothing."""
    designs = {"imaging1": tiny_study()["designs"]["imaging1"]}
    write("study.yaml", dump(parse(tiny_study() | {"designs": designs})))
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
    designs = {"imaging1": tiny_study()["designs"]["imaging1"]}
    elements = tiny_study()["elements"] | {"doublet": ["COC", "OKP4"]}
    changes = {"designs": designs, "elements": elements, "tables": ["table1"]}
    write("study.yaml", dump(parse(tiny_study() | changes)))
    assert study("plan", "study.yaml", "--json") == 0
    (plan,) = json.loads(capsys.readouterr().out)["points"]
    counts = {stage: len(jobs["missing"]) for stage, jobs in plan["jobs"].items()}
    assert plan["study"] == "tiny" and counts["table"] == counts["report_page"] == 2 and counts["design"] == 2


def test_a_target_without_jobs_has_nothing_to_be_done(capsys):
    write("study.yaml", dump(parse(tiny_study())))
    assert study("plan", "study.yaml", "--target", "ablations") == 0
    assert "tiny: nothing to do for ablations." in capsys.readouterr().out


def test_a_target_of_another_study_is_reported(capsys):
    write("study.yaml", dump(parse(tiny_study())))
    why = complaint(capsys, "plan", "study.yaml", "--target", "results/small/report.html")
    assert "has jobs of the study small, not tiny" in why


def test_an_unknown_target_is_reported(capsys):
    write("study.yaml", dump(parse(tiny_study())))
    why = complaint(capsys, "plan", "study.yaml", "--target", "nothing")
    assert "cannot plan nothing of study.yaml" in why and "No rule to produce nothing" in why


# ---- diff


def test_diff_lists_changed_values_and_results(results, capsys):
    """Changes of the configuration come first, then accuracies of the tables or all columns, except the paper's."""
    assert study("diff", "results/tiny", "results/tiny_2") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["name: tiny -> tiny_2", "spec.f_number: 2.8 -> 2.0"]
    assert lines[-2:] == ["table1", "  singlet-imaging1  accuracy 60 -> 55.5 (-4.5)"]
    assert study("diff", "--all", "results/tiny", "results/tiny_2") == 0
    assert "  singlet-imaging1  rms_spot_um 4 -> 9 (+5)" in capsys.readouterr().out.splitlines()
    assert study("diff", "--json", "results/tiny", "results/tiny_2") == 0
    differences = json.loads(capsys.readouterr().out)
    assert {"key": "spec.f_number", "old": 2.8, "new": 2.0} in differences["changes"]
    assert {row["column"]: row["new"] for row in differences["tables"]} == {"accuracy": 55.5, "rms_spot_um": 9.0}


def test_diff_of_equal_studies_and_of_one_without_tables(results, capsys):
    """The command also takes their files; it reports a row that only one study has."""
    assert study("diff", "results/tiny", "results/tiny") == 0
    out = capsys.readouterr().out
    assert "The configurations are equal." in out and "The tables are equal." in out
    write("results/tiny_3/study.yaml", Path("results/tiny/study.yaml").read_text())
    write("results/tiny_3/tables/table1.csv", TABLE.format(60, 5))
    assert study("diff", "results/tiny", "results/tiny_3") == 0
    assert "The accuracies are equal; --all compares all columns." in capsys.readouterr().out
    write("results/tiny_4/study.yaml", Path("results/tiny/study.yaml").read_text())
    write("results/tiny_4/tables/table2.csv", TABLE.format(60, 5))
    assert study("diff", "results/tiny", "results/tiny_4") == 0
    assert "none of the paper's tables in common" in capsys.readouterr().out
    write("new.yaml", dump(parse(tiny_study() | {"name": "fresh"})))
    assert study("diff", "results/tiny", "new.yaml") == 0
    assert capsys.readouterr().out.splitlines() == ["name: tiny -> fresh", "", "No tables yet in results/fresh."]
    with open("results/tiny/tables/table1.csv", "a") as file:
        file.write("singlet,imaging2,70,,\n")
    assert study("diff", "results/tiny", "results/tiny_2") == 0
    assert "singlet-imaging2  accuracy 70 -> none" in capsys.readouterr().out


# ---- export


def test_an_export_has_what_a_colleague_needs(results, capsys):
    """All files except images, checkpoints, weights, and unfinished files of a running job."""
    assert study("export", "results/tiny") == 0
    assert "tiny.zip: 6 files" in capsys.readouterr().out
    paths = ("study.yaml", "tables/table1.csv", "lenses/a/seed0/lens.yaml", "metrics/a.csv", "logs/images.log")
    with zipfile.ZipFile("tiny.zip") as archive:
        names = set(archive.namelist())
        assert archive.testzip() is None
        assert names == {f"tiny/{name}" for name in (*paths, "benchmarks/images.tsv", "README.txt")}
        write("study.yaml", archive.read("tiny/study.yaml").decode())
    assert load("study.yaml").name == "tiny"
    assert study("export", "results/tiny", "--with-weights", "--output", "all.zip") == 0
    with zipfile.ZipFile("all.zip") as archive:
        weights = "classifiers/reference/small", "restoration/a/nafnet", "tasks/reference/pixels"
        assert set(archive.namelist()) == names | {f"tiny/{name}.safetensors" for name in weights}


def test_export_overwrites_nothing(results, capsys):
    write("tiny.zip", "mine")
    assert "--force" in complaint(capsys, "export", "results/tiny")
    assert study("export", "results/tiny", "--force") == 0 and zipfile.is_zipfile("tiny.zip")


def test_export_of_the_present_folder_has_its_name(results, monkeypatch):
    monkeypatch.chdir(results / "tiny")
    assert study("export", ".", "--output", "../../out.zip") == 0
    with zipfile.ZipFile("../../out.zip") as archive:
        assert {name.split("/")[0] for name in archive.namelist()} == {"tiny"}


# ---- bad places


@pytest.mark.parametrize("command", ["status", "export", "diff", "check", "plan"])
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
    assert words in complaint(capsys, command, bad, *([bad] if command == "diff" else []))


def test_a_study_without_results_is_reported(place, capsys):
    write("study.yaml", dump(parse(tiny_study())))
    assert "results/tiny: contains no study.yaml" in complaint(capsys, "export", "study.yaml")
    assert "no run of this study" in complaint(capsys, "status", "study.yaml")
