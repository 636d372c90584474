"""Display of a run in progress: its state in files, the lines of the terminal, and the output of `status`."""

import json
import logging
import os
import socket
import subprocess
import time
from pathlib import Path

import pytest
from examples import write
from studies import tiny_study

from tasklens.cli.app import main
from tasklens.runtime.progress import Progress, progress_file
from tasklens.study.loading import dump, parse
from tasklens.study.run import closing, runs
from tasklens.study.run.changes import PlannedJob
from tasklens.study.run.forecast import Durations
from tasklens.study.run.terminal import Terminal

STUDY = parse(tiny_study())
FOLDER = "results/tiny"
DESIGN, TUNE = "design/singlet-imaging1-seed0", "fine_tune/singlet-imaging1-small-seed0"
LENS, TABLE = f"{FOLDER}/lenses/singlet-imaging1/seed0/lens.yaml", f"{FOLDER}/metrics/singlet-imaging1/seed0/small.csv"
OUTPUTS = {DESIGN: [LENS], TUNE: [TABLE]}


@pytest.fixture
def place(here):
    """A folder with the results of a study that has just begun: its file alone."""
    write(f"{FOLDER}/study.yaml", dump(STUDY))
    return here


def benchmark(label: str, seconds: float) -> None:
    write(f"{FOLDER}/benchmarks/{label}.tsv", f"s\tmax_rss\n{seconds}\t500\n")


def durations() -> Durations:
    return Durations("tiny", FOLDER)


def run_of(**rules: int) -> runs.Run:
    """A run of some jobs of each rule, of our own process."""
    jobs = {f"{rule}/{k}": runs.Job(rule) for rule, count in rules.items() for k in range(count)}
    return runs.Run("tiny", FOLDER, 2, jobs)


def status(capsys, *options: str) -> str:
    assert main(["study", "status", *options, FOLDER]) == 0
    return capsys.readouterr().out


# ---- state of a run


def test_the_state_of_a_run_is_read_as_it_was_written(place):
    run = run_of(design=2, table=1)
    run.begin("design/0")
    run.end("design/0", runs.DONE, 3.5, "RMS spot 2.0 um")
    run.begin("design/1")
    run.begin("images")  # a job of another run, not part of this one
    read_run = runs.read(place / FOLDER)
    assert read_run.jobs == run.jobs and read_run.is_alive and read_run.pid == os.getpid()
    labels = [read_run.labels(state) for state in (runs.DONE, runs.RUNNING, runs.WAITING)]
    assert labels == [["design/0"], ["design/1"], ["table/0"]]
    run.finish()
    assert not runs.read(place / FOLDER).is_alive
    assert runs.read(place) is None


def test_the_time_left_adds_up(place):
    """Two designs of 100 s and a table of 4 s on two cores: 102 s.

    Unknown stages take longer than that; if no stage is known, there is no forecast.
    """
    run = run_of(design=2, table=1)
    assert runs.headline([(run, durations())]) == "0 of 3 jobs"
    benchmark("table/a", 4)
    assert runs.headline([(run, durations())]) == "0 of 3 jobs, more than 2.0 s left"
    benchmark("design/a", 100)
    assert runs.seconds_left([(run, durations())]) == pytest.approx(102)
    assert runs.headline([(run, durations())]) == "0 of 3 jobs, about 2 min left"
    run.begin("design/0")
    run.jobs["design/0"].started -= 40.0
    assert runs.seconds_left([(run, durations())]) == pytest.approx(82, abs=1)
    run.end("design/0", runs.FAILED)
    assert runs.headline([(run, durations())]) == "0 of 3 jobs, 1 failed, about 52 s left"


def test_the_longest_running_job_keeps_the_others_waiting(place):
    """The time left is at least the time left of any single job by its own progress."""
    run = run_of(design=1)
    run.begin("design/0")
    write(f"{FOLDER}/progress/design/0.json", json.dumps({"updated": time.time() - 10, "remaining_s": 310.0}))
    assert runs.seconds_left([(run, durations())]) == pytest.approx(300, abs=2)
    assert runs.headline([(run, durations())]) == "0 of 1 jobs, about 5 min left"


# ---- progress of a job


def test_a_running_job_says_how_far_it_is(place, monkeypatch):
    """Phase, step, values and the time left of the phase, from a file that ends with the job."""
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    run = run_of(design=1)
    run.begin("design/0")
    assert run.describe("design/0", durations()) == "design 0  starting"
    with progress_file(FOLDER, "design/0"):
        progress = Progress("descent 1, lens 1 of 2", 10)
        for step in range(1, 5):
            clock[0] += 20.0
            progress(step, loss=0.123456)
        assert run.describe("design/0", durations()) == "design 0  descent 1, lens 1 of 2 4/10  loss 0.1235  2 min left"
        Progress("descent 2", 3)(1)  # the next phase has no duration yet
        clock[0] += 5.0
        report = run.progress("design/0")
        assert (report["pid"], report["host"]) == (os.getpid(), socket.gethostname())
    assert run.progress("design/0") is None
    assert not [path for path in (place / FOLDER / "progress").rglob("*") if path.is_file()]


def test_a_silent_job_is_reported(place):
    """A job that should report and has not for ten minutes: its machine may have died."""
    run = run_of(design=1)
    run.begin("design/0")
    state = {"updated": time.time() - 600, "phase": "descent 2", "step": 1, "total": 3, "values": {}}
    write(f"{FOLDER}/progress/design/0.json", json.dumps(state))
    assert run.describe("design/0", durations()) == "design 0  descent 2 1/3  silent for 10 min"
    write(f"{FOLDER}/progress/design/0.json", "{half")
    assert run.describe("design/0", durations()) == "design 0  starting"


# ---- lines of the terminal


class Snakemake:
    """A logger such as Snakemake's, with its own handler, to which a test reports as Snakemake does."""

    def __init__(self, quiet: bool = False, handler: str = "DefaultStreamHandler"):
        self.logger = logging.Logger("snakemake.test")
        default = logging.StreamHandler()
        default.name = handler
        self.logger.addHandler(default)
        self.terminal = Terminal(STUDY, lambda name: STUDY, quiet, str, self.logger)

    def begin(self) -> None:
        jobs = {label: PlannedJob("tiny", label, True, (), (), "{}") for label in (DESIGN, TUNE)}
        self.terminal.begin({STUDY.name: jobs}, 2)

    def say(self, message: str, level: int = logging.INFO, **extra) -> None:
        self.logger.log(level, message, extra=extra)

    def job(self, event: str, number: int, label: str, level: int = logging.INFO) -> None:
        log, output = [f"{FOLDER}/logs/{label}.log"], OUTPUTS[label]
        names = {"job_info": "jobid", "job_finished": "job_id", "job_error": "jobid"}
        self.say("a job", level, event=event, log=log, output=output, **{names[event]: number})


@pytest.fixture
def snakemake(place):
    fake = Snakemake()
    yield fake
    fake.terminal.close()


def test_a_finished_job_has_one_line(snakemake, capsys):
    """Job, duration and result; none of Snakemake's own lines about the job."""
    snakemake.begin()
    snakemake.say("Building DAG of jobs...")
    snakemake.job("job_info", 7, TUNE)
    snakemake.say("Shell command: tasklens run ...", event="shellcmd")
    write(TABLE, "metric,value\naccuracy,40\naccuracy,50\nchance,10\n")
    benchmark(TUNE, 75)
    snakemake.job("job_finished", 7, TUNE)
    (line,) = capsys.readouterr().err.splitlines()
    assert " ".join(line.split()) == "1/2 fine_tune singlet-imaging1-small-seed0 1 min accuracy 45.0 %"
    job = runs.read(Path(FOLDER)).jobs[TUNE]
    assert (job.state, job.seconds, job.result) == (runs.DONE, 75.0, "accuracy 45.0 %")


def test_a_failed_job_shows_the_end_of_its_log(snakemake, capsys):
    """The last lines, the path of the log, and the retry; `status` has the last line too."""
    snakemake.begin()
    snakemake.job("job_info", 4, TUNE)
    snakemake.job("job_error", 4, TUNE, logging.ERROR)
    assert "the job was killed, or did not start" in capsys.readouterr().err  # without a log
    log = [f"line {k}" for k in range(40)] + ["", "tasklens: lens.yaml: no such file"]
    write(f"{FOLDER}/logs/{DESIGN}.log", "\n".join(log) + "\n")
    snakemake.job("job_info", 3, DESIGN)
    snakemake.job("job_error", 3, DESIGN, logging.ERROR)
    snakemake.say("Trying to restart job 3.", logging.INFO)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("FAILED  design singlet-imaging1-seed0  after ")
    assert f"{FOLDER}/logs/{DESIGN}.log" in lines[0]
    assert lines[1:-1] == [f"    line {k}" for k in range(29, 40)] + ["    tasklens: lens.yaml: no such file"]
    assert lines[-1].strip() == "the job is tried again"
    out = status(capsys)
    assert "0 of 2 jobs, 2 failed" in out
    assert "FAILED  design singlet-imaging1-seed0: tasklens: lens.yaml: no such file" in out
    snakemake.job("job_info", 3, DESIGN)
    assert "FAILED  design" not in status(capsys)


def test_a_job_ended_by_the_user_has_not_failed(snakemake, capsys):
    """Ctrl-C ends the jobs that run: they wait for the next run, and none counts as failed."""
    snakemake.begin()
    snakemake.job("job_info", 3, DESIGN)
    snakemake.say("Terminating processes on user request, this might take some time.")
    snakemake.job("job_error", 3, DESIGN, logging.ERROR)
    assert capsys.readouterr().err.splitlines()[1:] == ["stopped  design singlet-imaging1-seed0"]
    assert runs.read(Path(FOLDER)).labels(runs.WAITING) == [DESIGN, TUNE]
    message = closing.failure(snakemake.terminal.runs)
    assert "FAILED" not in message and "The same command continues from here." in message


def test_warnings_are_shown_and_chatter_is_not(snakemake, capsys):
    snakemake.say("Using shell: /bin/bash", logging.INFO)
    snakemake.say("Exiting because a job execution failed. Look below", logging.ERROR)
    snakemake.say("the disk is full", logging.ERROR)
    snakemake.say("Will exit after finishing currently running jobs.", logging.INFO)
    will_exit = "Will exit after finishing currently running jobs."
    assert capsys.readouterr().err.splitlines() == ["the disk is full", will_exit]


def test_a_finished_study_says_where_its_results_are(snakemake, capsys):
    snakemake.say("Nothing to be done (all requested files are present and up to date).")
    output = capsys.readouterr().err
    assert output.startswith("Nothing to be done.") and f"Results: {FOLDER}/" in output
    snakemake.terminal.unrecorded = lambda: "made with other settings"
    snakemake.say("Nothing to be done (all requested files are present and up to date).")
    assert capsys.readouterr().err.strip() == "made with other settings"


@pytest.mark.parametrize("options", [{"quiet": True}, {"handler": "SomeOtherHandler"}])
def test_quiet_or_another_logger_prints_no_lines_of_ours(place, capsys, options):
    """With `--quiet` or another logger; the state is still saved."""
    snakemake = Snakemake(**options)
    snakemake.begin()
    snakemake.terminal.console.print("not shown")
    snakemake.job("job_info", 3, DESIGN)
    assert len(snakemake.logger.handlers) == 2  # that of Snakemake has stayed
    assert runs.read(place / FOLDER).labels(runs.RUNNING) == [DESIGN]
    snakemake.terminal.close()
    assert runs.read(place / FOLDER).ended is not None


def test_what_cannot_be_shown_does_not_end_the_run(snakemake, monkeypatch, capsys):
    """A finished job with broken files is still finished."""
    monkeypatch.setattr(logging, "raiseExceptions", False)
    snakemake.begin()
    snakemake.job("job_info", 3, DESIGN)
    write(LENS, "[")
    snakemake.job("job_finished", 3, DESIGN)
    assert runs.read(Path(FOLDER)).jobs[DESIGN].state == runs.DONE


# ---- what another terminal says


def test_status_says_what_runs(place, capsys):
    run = run_of(design=2)
    run.begin("design/1")
    assert status(capsys).splitlines() == ["tiny: 0 of 2 jobs", "  design 1  starting"]
    content = json.loads(status(capsys, "--json"))
    (report,) = content["points"]
    assert content["study"] == report["study"] == "tiny"
    assert report["alive"] is True and report["jobs"]["design/1"]["state"] == "running"
    assert report["progress"] == {"design/1": None}


def test_status_of_runs_that_ended_or_were_killed(place, capsys):
    """The process of the latter has ended; a run on another machine counts as running, since this one cannot know."""
    run = run_of(design=2)
    run.end("design/0", runs.DONE, 1.0)
    run.started -= 300
    run.finish()
    assert status(capsys) == "tiny: the last run ended after 5 min, 1 of 2 jobs done\n"
    run = run_of(design=2)
    process = subprocess.Popen(["true"])
    process.wait()
    run.pid = process.pid
    run.save()
    out = status(capsys)
    assert "the last run was killed, 0 of 2 jobs done" in out and "snakemake --unlock" in out
    run.host = "another"
    run.save()
    assert status(capsys) == "tiny: 0 of 2 jobs\n"


@pytest.mark.parametrize("content", ["{half", '{"jobs": {"a": {"colour": 1}}}'])
def test_a_broken_state_is_reported_in_one_line(place, capsys, content):
    write(f"{FOLDER}/run.json", content)
    assert main(["study", "status", FOLDER]) == 2
    error = capsys.readouterr().err
    assert "run.json" in error and error.count("\n") == 1
