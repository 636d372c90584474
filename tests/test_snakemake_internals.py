"""Tests that the parts of Snakemake used beyond its documented interface exist and keep their meaning."""

import logging
import os
import signal
import threading
from types import SimpleNamespace

import pytest
from rules import ROOT, workflow
from snakemake.scheduling.job_scheduler import JobRateLimiter
from snakemake.settings.types import ExecMode, MaxJobsPerTimespan
from studies import one_lens, tiny_study
from workflows import forked, snakemake

from tasklens.study.run import planning, snakemake_internals


def test_the_settings_of_a_run():
    """Files, cores and kind of the process of a workflow that Snakemake has made."""
    flow = workflow()
    assert snakemake_internals.configfiles(flow) == [ROOT / "config" / "smoke.yaml"]
    assert snakemake_internals.cores(flow) == 1 and snakemake_internals.is_quiet(flow)
    assert snakemake_internals.is_main(flow) and flow.modifier.is_main_snakefile()
    job = SimpleNamespace(exec_mode=ExecMode.SUBPROCESS, modifier=flow.modifier)
    assert not snakemake_internals.is_main(job)


@pytest.mark.slow
def test_the_jobs_of_a_run(here):
    """Labels, needs and settings before a run; outputs and the settings that made them after it."""
    study = one_lens()
    lens = "results/tiny/lenses/singlet-imaging1/seed0/lens.yaml"

    def jobs(target: str) -> dict:
        assert forked(here, study, "--dry-run", target, "--config", f"plan={here}/jobs.json")[0] == 0
        return {job["label"]: job for job in planning.json.loads((here / "jobs.json").read_text())}

    before = jobs("table1")
    assert all(job["remains"] and not job["outputs"] and job["made_with"] is None for job in before.values())
    needs = before["fine_tune/singlet-imaging1-small-seed0"]["needs"]
    assert sorted(needs) == ["images", "psfs/singlet-imaging1-seed0", "reference/small"]
    assert snakemake(here, study, lens).returncode == 0
    design = jobs("table1")["design/singlet-imaging1-seed0"]
    assert not design["remains"] and lens in design["outputs"]
    assert design["made_with"] == design["settings"] == before["design/singlet-imaging1-seed0"]["settings"]


@pytest.mark.slow
def test_the_terminal_is_taken_from_snakemake(tmp_path):
    """From the handler that a run of Snakemake has by default; a chosen one, or --quiet, keeps it."""
    process = snakemake(tmp_path, tiny_study(), "results/tiny/images/train.npy", "--quiet", "all")
    assert process.returncode == 0 and "1/1  images" not in process.stderr
    logger = logging.Logger("snakemake.test")
    handler = logging.NullHandler()
    assert not snakemake_internals.take_terminal(handler, False, logger) and logger.handlers == [handler]


@pytest.mark.parametrize("limit, kept", [("100/1s", False), ("5/1s", True), ("100/1m", True)])
def test_the_default_limit_of_jobs_per_second_is_switched_off(limit, kept):
    """A limit that the user has chosen stays."""
    scheduler = SimpleNamespace(job_rate_limiter=JobRateLimiter(MaxJobsPerTimespan.parse_choice(limit)))
    snakemake_internals.limit_no_rate(SimpleNamespace(scheduler=scheduler))
    assert (scheduler.job_rate_limiter is not None) == kept


def test_a_run_is_terminated_while_its_scheduler_has_its_lock():
    """The signal handler takes the same lock; it waits for the lock instead of blocking the thread that holds it."""
    lock, ended, before = threading.Lock(), threading.Event(), signal.getsignal(signal.SIGTERM)

    def exit_gracefully(*_: object) -> None:
        with lock:
            ended.set()

    try:
        signal.signal(signal.SIGTERM, exit_gracefully)
        snakemake_internals.terminate_safely()
        with lock:
            os.kill(os.getpid(), signal.SIGTERM)
            assert not ended.wait(0.1)
        assert ended.wait(10)
    finally:
        signal.signal(signal.SIGTERM, before)
