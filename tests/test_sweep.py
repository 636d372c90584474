"""Sweeps: a study at every point of a grid, each in its own folder, and one table of all points."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pandas
import pytest
import yaml
from examples import write
from rules import finish
from studies import one_lens
from workflows import forked, snakemake

from tasklens.cli.app import main
from tasklens.study.loading import at_points, dump, load, parse
from tasklens.study.run import closing, runs
from tasklens.study.run.changes import PlannedJob
from tasklens.study.run.forecast import Durations
from tasklens.study.run.terminal import Terminal
from tasklens.study.study import StudyError

GRID = {"spec.f_number": [2.0, 2.8], "capture.diffraction": [False, True]}
POINTS = [
    "spec.f_number=2.0--capture.diffraction=false",
    "spec.f_number=2.0--capture.diffraction=true",
    "spec.f_number=2.8--capture.diffraction=false",
    "spec.f_number=2.8--capture.diffraction=true",
]


def swept_lens(**sweep: list) -> dict:
    return one_lens(tables=["table1"], sweep=sweep)


@pytest.fixture
def swept(here):
    return parse(swept_lens(**GRID))


def test_each_point_is_the_study_with_these_values(swept, tmp_path):
    """Its name is below the study's, and nothing else changes; it reads back as it was written."""
    studies = at_points(swept)
    assert [study.name for study in studies] == [f"tiny/{point}" for point in POINTS]
    values = [(study.spec.f_number, study.capture.diffraction) for study in studies]
    assert values == [(2.0, False), (2.0, True), (2.8, False), (2.8, True)]
    plain = parse(swept_lens())
    assert at_points(plain) == [plain]
    assert studies[2].model_copy(update={"name": "tiny"}) == plain.model_copy(update={"spec": studies[2].spec})
    write("results/study.yaml", dump(studies[1]))
    assert load("results/study.yaml") == studies[1]


def test_slashes_of_a_path_are_hyphens_in_its_folder():
    (study,) = at_points(parse(swept_lens(**{"images.folder": ["data/mine"]})))
    assert study.name == "tiny/images.folder=data-mine" and study.images.folder == Path("data/mine")


@pytest.mark.slow
def test_a_changed_value_is_asked_about_at_each_point(tmp_path):
    """One point has a lens made with another limit; the other point has no lens yet."""
    lens = "results/tiny/spec.f_number=2.0/lenses/singlet-imaging1/seed0/lens.yaml"
    assert snakemake(tmp_path, swept_lens(**{"spec.f_number": [2.0]}), lens).returncode == 0
    changed = swept_lens(**{"spec.f_number": [2.0, 2.8]}) | {"constraints": {"max_track": 4.2}}
    status, output = forked(tmp_path, changed, "--dry-run", "table1")
    assert status == 0 and "results of the study tiny/spec.f_number=2.0; nothing was changed" in output
    assert "--config name=tiny_2" in output and output.count("nothing was changed") == 1
    point = [tmp_path / "results/tiny/spec.f_number=2.0/study.yaml"]  # a study like others
    assert snakemake(tmp_path, point, "results/tiny/spec.f_number=2.0/images/train.npy").returncode == 0
    status, output = forked(tmp_path, swept_lens(**{"spec.f_number": [2.0]}), "--dry-run", "verify")
    assert status != 0 and "verify: a sweep is verified point by point" in output


def tables(study, accuracies: list[float]) -> None:
    """Table 1 of every point, with the accuracy of its lens."""
    for point, accuracy in zip(at_points(study), accuracies, strict=True):
        rows = f"elements,design,accuracy,rms_spot_um\n,reference,80,\nsinglet,imaging1,{accuracy},{accuracy / 10}\n"
        write(f"results/{point.name}/tables/table1.csv", rows)


def test_numbers_of_all_points_stand_beside_each_other(swept):
    """Accuracies as columns of points in the order of the grid; all numbers with the swept values in the CSV file."""
    tables(swept, [10, 20, 30, 40])
    finish("sweep_table", swept)
    lines = [line for line in Path("results/tiny/sweep.md").read_text().splitlines() if line.startswith("| table")]
    assert [cell.strip() for cell in lines[0].split("|")[3:-1]] == POINTS
    assert [cell.strip() for cell in lines[2].split("|")[2:-1]] == ["singlet-imaging1", "10.0", "20.0", "30.0", "40.0"]
    rows = pandas.read_csv("results/tiny/sweep.csv")
    one = rows[(rows["spec.f_number"] == 2.8) & rows["capture.diffraction"] & (rows["row"] == "singlet-imaging1")]
    assert dict(zip(one["column"], one["value"], strict=True)) == {"accuracy": 40, "rms_spot_um": 4}


def test_a_sweep_ends_with_its_table(swept):
    tables(swept, [10, 20, 30, 40])
    finish("sweep_table", swept)
    write(f"results/tiny/{POINTS[1]}/report.html", "")
    message = closing.success(swept, {})
    assert "| singlet-imaging1 |" in message and f"  results/tiny/{POINTS[1]}/report.html" in message
    part = runs.Run(f"tiny/{POINTS[0]}", f"results/tiny/{POINTS[0]}", 1, {"images": runs.Job("images")})
    assert "| singlet" not in closing.success(swept, {part.study: part})  # a run that did not remake the table
    part.end("images", runs.FAILED)
    other = replace(part, study=f"tiny/{POINTS[1]}", jobs={})
    message = closing.failure({part.study: part, other.study: other})
    assert f"Study tiny/{POINTS[0]}: 0 of 1 jobs done." in message and message.count("FAILED") == 1


def test_points_side_by_side_share_the_cores(swept):
    """Two points on two cores, each with a job of a hundred seconds, take a hundred seconds."""
    pairs = []
    for point in POINTS[:2]:
        folder = f"results/tiny/{point}"
        write(f"{folder}/benchmarks/design/a.tsv", "s\tmax_rss\n100\t1\n")
        run = runs.Run(f"tiny/{point}", folder, 2, {"design/b": runs.Job("design")})
        pairs.append((run, Durations("tiny", folder)))
    assert runs.seconds_left(pairs) == pytest.approx(100)
    assert runs.headline(pairs) == "0 of 2 jobs, about 2 min left"


@pytest.mark.parametrize("name", ["tiny/tables", "tiny/a=../b", "tiny/a=b/c=d"])
def test_a_name_leads_nowhere_else(name):
    with pytest.raises(StudyError, match="name"):
        parse(swept_lens() | {"name": name})


def test_jobs_of_all_points_are_counted_together(swept, capsys):
    """A line for each job with its point; the state of each point in its own folder, for `status`."""
    logger = logging.Logger("snakemake.test")
    default = logging.StreamHandler()
    default.name = "DefaultStreamHandler"
    logger.addHandler(default)
    terminal = Terminal(swept, lambda name: swept, False, str, logger)
    label = "design/singlet-imaging1-seed0"
    jobs = {f"tiny/{point}": {label: PlannedJob(f"tiny/{point}", label, True, (), (), "{}")} for point in POINTS}
    terminal.begin(jobs, 2)
    log = [f"results/tiny/{POINTS[2]}/logs/{label}.log"]
    output = [f"results/tiny/{POINTS[2]}/lenses/singlet-imaging1/seed0/lens.yaml"]
    lens = {"figures": {"rms_centroid_um": [1.0, 2.0]}, "origin": {}, "worst_margin": {"value": 0.1, "limit": "gap"}}
    write(output[0], yaml.safe_dump(lens))
    logger.info("", extra={"event": "job_info", "jobid": 7, "log": log, "output": output})
    logger.info("", extra={"event": "job_finished", "job_id": 7})
    terminal.close()
    errors = capsys.readouterr().err
    assert errors.startswith(f"1/4  {POINTS[2]} design singlet-imaging1-seed0") and "RMS spot 1.5 um" in errors
    states = [runs.read(Path("results/tiny", point)).jobs[label].state for point in POINTS]
    assert states == [runs.WAITING, runs.WAITING, runs.DONE, runs.WAITING]


def test_commands_know_the_points(here, capsys):
    """`plan`, `check` and `status` report each point."""
    write("study.yaml", yaml.safe_dump(swept_lens(**{"spec.f_number": [2.0, 2.8]})))
    assert main(["study", "plan", "study.yaml", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    names = ["tiny", "tiny/spec.f_number=2.0", "tiny/spec.f_number=2.8"]
    assert report["study"] == "tiny" and [point["study"] for point in report["points"]] == names
    assert report["points"][1]["jobs"]["design"]["missing"] == ["design/singlet-imaging1-seed0"]
    assert main(["study", "check", "study.yaml", "--no-weight-files"]) == 0
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == names[1:]
    for point in ("spec.f_number=2.0", "spec.f_number=2.8"):
        runs.Run(f"tiny/{point}", f"results/tiny/{point}", 2, {"images": runs.Job("images")}).save()
    write("results/tiny/study.yaml", dump(load("study.yaml")))
    assert main(["study", "status", "study.yaml"]) == 0
    output = capsys.readouterr().out
    assert all(f"{name}: 0 of 1 jobs" in output for name in names[1:])
    assert main(["study", "status", "study.yaml", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["study"] == "tiny" and [point["study"] for point in report["points"]] == names[1:]
