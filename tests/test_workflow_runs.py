"""The study as a workflow: a real small run, reruns after a change, and runs that fail or are killed."""

import json
import os
import shutil
import subprocess
import time

import pytest
import yaml
from examples import read_rows, write
from studies import changed, one_lens, tiny_study
from workflows import command, forked, plan, smoke_with_imported, snakemake

from tasklens.cli.app import main
from tasklens.study.loading import dump, load, parse
from tasklens.study.run.forecast import Durations

STAGES_OF_TABLE_1 = {"images": 1, "reference": 1, "design": 1, "psfs": 1, "fine_tune": 2, "table": 1}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Table 1 of one lens, from a real run."""
    folder = tmp_path_factory.mktemp("run")
    process = snakemake(folder, one_lens(), "table1")
    assert process.returncode == 0, process.stdout + process.stderr
    assert "Study tiny: 7 jobs" in process.stdout and "results/tiny/tables/table1.md" in process.stdout
    assert "Building DAG" not in process.stderr
    ends = [line.split()[0] for line in process.stderr.splitlines() if "/7  " in line]
    assert ends == [f"{k}/7" for k in range(1, 8)], process.stderr
    return folder


@pytest.mark.slow
def test_a_finished_table_has_nothing_to_be_done(finished):
    """The run wrote the study with every default, the table, and is complete."""
    assert load(finished / "results/tiny/study.yaml") == parse(one_lens())
    text = (finished / "results/tiny/tables/table1.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in text[1:]] == [["", "reference"], ["singlet", "imaging1"]]
    assert plan(finished, one_lens(), "table1") == {}


@pytest.mark.slow
def test_durations_of_finished_jobs_are_known(finished):
    """A benchmark file for every job, from which the next forecast, time limits and memory are made."""
    files = sorted((finished / "results/tiny/benchmarks").rglob("*.tsv"))
    assert len(files) == sum(STAGES_OF_TABLE_1.values())
    durations = Durations("tiny", str(finished / "results/tiny"))
    assert durations.here.keys() == STAGES_OF_TABLE_1.keys()
    assert all(0 < durations.seconds(stage) < 120 for stage in STAGES_OF_TABLE_1)
    assert "about" in durations.forecast(["design"], 1)
    _, output = forked(finished, changed(one_lens(), "constraints.max_track", 4.2), "--dry-run", "table1")
    assert f"mem_mb={durations.memory_mb('design')}," in output and durations.memory_mb("design") not in (0, 4000)
    assert f"runtime={durations.limit_minutes('design')}," in output


@pytest.mark.slow
def test_finished_results_are_not_overwritten_without_consent(finished):
    """A dry run asks too; a further seed needs no consent; no file changes, and the last run's state stays."""
    faster = changed(one_lens(), "spec.f_number", 2.0)
    paths = [path for path in (finished / "results").rglob("*") if path.is_file()]
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}
    process = snakemake(finished, faster, "table1")
    output = process.stdout + process.stderr
    assert process.returncode != 0 and "spec.f_number: 2.8 -> 2.0: 1 lens, 1 classifier again" in output, output
    assert "--config overwrite=true" in output and "Traceback" not in output and "goes on from here" not in output
    assert "1 lens, 1 classifier again" in forked(finished, faster, "--dry-run", "table1")[1]
    stored = finished / "results/tiny/study.yaml"
    stored.write_text(dump(parse(faster)))  # as by a run of the changed study that left the lens alone
    assert "1 lens, 1 classifier again" in forked(finished, faster, "--dry-run", "table1")[1]
    stored.write_bytes(before[stored][0])
    os.utime(stored, ns=2 * (before[stored][1],))
    for study, *others in ((faster, "--config", "overwrite=true"), (one_lens() | {"seeds": [0, 1]},)):
        status, output = forked(finished, study, "--dry-run", "table1", *others)
        assert status == 0 and "again" not in output and "design" in output
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths} == before
    assert {path for path in (finished / "results").rglob("*") if path.is_file()} == set(paths)


@pytest.mark.slow
def test_touched_results_are_those_of_the_present_study(finished, tmp_path):
    """The user may say so with Snakemake's own option; nothing runs, and nothing is left to do."""
    folder = tmp_path / "copy"
    shutil.copytree(finished, folder)
    lens = folder / "results/tiny/lenses/singlet-imaging1/seed0/lens.yaml"
    before, faster = lens.read_bytes(), changed(one_lens(), "spec.f_number", 2.0)
    assert forked(folder, faster, "table1", "--touch")[0] == 0
    assert plan(folder, faster, "table1") == {} and lens.read_bytes() == before


@pytest.mark.slow
def test_commands_know_what_has_run(finished, monkeypatch, capsys):
    """No job is left to plan; with another value, the plan has the reruns; `status` has the last run's jobs."""
    monkeypatch.chdir(finished)
    write("study.yaml", yaml.safe_dump(one_lens()))
    assert main(["study", "plan", "study.yaml", "--target", "table1"]) == 0
    assert "tiny: nothing to do for table1." in capsys.readouterr().out
    write("faster.yaml", yaml.safe_dump(changed(one_lens(), "spec.f_number", 2.0)))
    assert main(["study", "plan", "faster.yaml", "--target", "table1", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)["points"]
    assert report["changed"] == ["spec.f_number: 2.8 -> 2.0"]
    again = {stage: len(jobs["rerun"]) for stage, jobs in report["jobs"].items() if jobs["rerun"]}
    assert again == {"design": 1, "psfs": 1, "fine_tune": 1, "table": 1}
    assert main(["study", "status", "results/tiny"]) == 0
    assert "7 of 7 jobs done" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "key, value, rerun",
    [
        ("restoration.steps", 9, {}),
        ("images.seed", 4, {"images": 1, "reference": 1, "design": 1, "psfs": 1, "fine_tune": 2, "table": 1}),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_changed_value_reruns_what_reads_it(finished, key, value, rerun):
    """All later jobs up to the table rerun too; all others stay."""
    counts = plan(finished, changed(one_lens(), key, value), "table1")
    assert counts == rerun


@pytest.mark.slow
def test_a_job_computes_what_its_run_was_started_with(tmp_path):
    """Later changes of the study's file and other runs of the study do not matter."""
    study = tiny_study()
    target = "results/tiny/lenses/singlet-image_error/seed0/lens.yaml"
    log = tmp_path / "results/tiny/logs/images.log"
    process = subprocess.Popen(command(tmp_path, study, target), cwd=tmp_path, stderr=subprocess.DEVNULL)
    while not log.exists():
        assert process.poll() is None
        time.sleep(0.05)
    other = changed(study, "designs.image_error.descents.1.steps", 7)
    other = changed(other, "designs.imaging1.descents.0.steps", 4)
    lens = "results/tiny/lenses/singlet-imaging1/seed0/lens.yaml"
    status, output = forked(tmp_path, other, lens, "--nolock")
    assert status == 0, output
    assert process.wait() == 0
    assert load(tmp_path / "results/tiny/study.yaml") == parse(other)
    steps = [row["step"] for row in read_rows(tmp_path / target.replace("lens.yaml", "history.csv"))]
    assert len(steps) == 2 + 2
    assert len(read_rows(tmp_path / lens.replace("lens.yaml", "history.csv"))) == 4


@pytest.mark.slow
def test_a_failing_job_leaves_no_output(tmp_path):
    """An unreadable image: the images job fails, names the file in its log, and leaves no split behind."""
    from PIL import Image

    for split, name in (("train", "a"), ("train", "b"), ("val", "a"), ("val", "b")):
        (tmp_path / "photos" / split / name).mkdir(parents=True)
        for k in range(3):
            Image.new("RGB", (16, 16)).save(tmp_path / "photos" / split / name / f"{k}.png")
    bad = tmp_path / "photos" / "val" / "b" / "1.png"
    bad.write_text("not an image")
    images = {"size": 16, "minival": 2, "folder": str(tmp_path / "photos")}
    process = snakemake(tmp_path, changed(one_lens(), "images", images), "results/tiny/images/train.npy")
    assert process.returncode != 0
    assert str(bad) in (tmp_path / "results/tiny/logs/images.log").read_text()
    lines = (process.stdout + process.stderr).splitlines()
    assert any(line.startswith("FAILED  images  after ") for line in lines), lines
    assert any(line.startswith(f"FAILED  images: tasklens: {bad}") for line in lines), lines
    left = [path for path in (tmp_path / "results/tiny/images").rglob("*") if path.is_file()]
    assert {path.suffix for path in left} <= {".lock"}  # of the writer, empty


@pytest.mark.slow
def test_a_changed_file_reruns_the_imported_lens(tmp_path):
    """The lens file or a catalogue; a file that cannot be used stops the study before its first job."""
    study, target = smoke_with_imported(tmp_path), "results/smoke/lenses/singlet-theirs/seed0/lens.yaml"
    process = snakemake(tmp_path, study, target)
    assert process.returncode == 0 and (tmp_path / target).exists(), process.stdout + process.stderr
    assert plan(tmp_path, study, target) == {}
    for name, old, new in (("singlet.zmx", "DISZ 0.5", "DISZ 0.6"), ("glass.agf", "2.3", "2.4")):
        path = tmp_path / name
        before, times = path.read_text(), (path.stat().st_atime, path.stat().st_mtime)
        path.write_text(before.replace(old, new))
        assert path.read_text() != before and plan(tmp_path, study, target) == {"design": 1}
        path.write_text(before)
        os.utime(path, times)
    path.write_text("NM COC 1 0 1.5\n")
    other = target.replace("singlet-theirs", "doublet-imaging2")
    process = snakemake(tmp_path, study, other)
    assert process.returncode != 0 and "glass.agf" in process.stdout + process.stderr
    assert not (tmp_path / other).exists()
