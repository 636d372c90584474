"""Closing message of a run: the study's answer, the place of its results, failures, and the next commands."""

from dataclasses import replace

import pytest
from examples import write
from studies import tiny_study

from tasklens.study.claims import OVER_IMAGE_QUALITY, OVER_IMAGING1, OVER_LEAST_SQUARES
from tasklens.study.loading import parse
from tasklens.study.run import closing, runs

FOLDER = "results/tiny"
COLUMNS = "table,claim,lens,baseline,classifier,difference,low,high,p_holm,seeds,verdict,reason\n"
CLAIMS = (
    ("table1", OVER_IMAGING1, 36.0, 34.0, 38.0, "suggests +36.0 points", ""),
    ("table1", OVER_LEAST_SQUARES, 3.56, 3.0, 4.1, "suggests +3.6 points", ""),
    ("table1", OVER_IMAGE_QUALITY, 0.4, -0.2, 1.0, "undecided", "at most 1.0 points either way"),
)
SENTENCES = [
    "Accuracy compared with the best lens for image quality (chosen on minival images): "
    "singlet tasklens +0.4 points (−0.2 to +1.0) compared with x, undecided.",
    "The one claim of the paper that is tested here is supported by every comparison.",
    "One seed can only suggest a difference; at least 5 are needed to show one. Intervals are 95 % over test images.",
]
pytestmark = pytest.mark.usefixtures("here")


def verdicts(*claims) -> None:
    rows = (
        f"{table},{text},singlet-tasklens,singlet-x,small,{value},{low},{high},0.01,1,{verdict},{reason}"
        for table, text, value, low, high, verdict, reason in claims
    )
    write(f"{FOLDER}/tables/verdicts.csv", COLUMNS + "\n".join(rows) + "\n")


def study(**changes):
    return parse(tiny_study() | changes)


def run_of(*labels: str) -> runs.Run:
    """A run of five minutes with all jobs done."""
    run = runs.Run("tiny", FOLDER, 1, {label: runs.Job(label.split("/")[0], runs.DONE) for label in labels})
    run.started -= 300
    return run


def test_a_study_that_has_verdicts_gives_its_answer():
    """With jobs, duration, page, and next commands for the study as it was run."""
    verdicts(*CLAIMS)
    write(f"{FOLDER}/report.html", "")
    run = run_of("design/a", "verdicts_table", "report_page")
    run.jobs["report_page"].result = f"{FOLDER}/report.html"
    run.finish()
    lines = closing.success(study(), {"tiny": run}).splitlines()
    first = lines.index("Study tiny: 3 jobs in 5 min.") + 1
    assert lines[first : first + len(SENTENCES)] == SENTENCES
    assert lines[lines.index(f"Results: {FOLDER}/") + 1].strip() == f"{FOLDER}/report.html"
    commands = [line for line in lines if line.startswith("  snakemake")]
    assert len(commands) == 3 and all(f"--configfile {FOLDER}/study.yaml" in line for line in commands)
    assert "--config 'seeds=[0, 1, 2, 3, 4]'" in commands[-1]
    assert "seeds=" not in closing.success(study(seeds=[0, 1, 2, 3, 4]), {"tiny": run})


def test_a_run_that_made_no_verdicts_does_not_repeat_old_ones():
    """It does not show an old page either; if no job had to run, answer and page are shown."""
    verdicts(*CLAIMS)
    write(f"{FOLDER}/report.html", "")
    run = run_of("certificate/a")
    run.jobs["certificate/a"].result = f"{FOLDER}/lenses/a/certificate.md"
    run.finish()
    text = closing.success(study(), {"tiny": run})
    assert "Accuracy" not in text and f"  {FOLDER}/lenses/a/certificate.md" in text.splitlines()
    assert f"  {FOLDER}/report.html" not in text.splitlines()
    again = closing.success(study(), {}).splitlines()
    assert {*SENTENCES, f"  {FOLDER}/report.html"} <= {*again}


def test_a_run_of_other_studies_says_where_they_are():
    run = replace(run_of("design/a"), study="other", folder="results/other")
    run.finish()
    lines = closing.success(study(), {"other": run}).splitlines()
    assert lines[1:] == ["Study other: 1 job in 5 min.", "Results: results/other/"]


def test_without_verdicts_all_tables_come_next():
    run = run_of("design/a")
    run.finish()
    text = closing.success(study(), {"tiny": run})
    assert "Accuracy" not in text and f"Results: {FOLDER}/" in text
    assert f"snakemake -j2 tables --configfile {FOLDER}/study.yaml" in text and "verify" not in text


def test_a_failed_run_says_what_failed_and_how_to_go_on():
    """Each failed job with the last line of its error and its log."""
    run = run_of("images", "design/a", "design/b", "table/table1")
    run.jobs["table/table1"].state = runs.WAITING
    run.end("design/a", runs.FAILED, 3.0, "tasklens: no such file")
    run.end("design/b", runs.FAILED, 3.0)
    lines = closing.failure({"tiny": run}).splitlines()
    assert "Study tiny: 1 of 4 jobs done." in lines
    at = lines.index("FAILED  design a: tasklens: no such file")
    assert lines[at + 1].strip() == f"{FOLDER}/logs/design/a.log"
    assert "FAILED  design b: its log is empty" in lines
    assert lines[-1].startswith("The same command continues from here; with --keep-going ")


def test_a_run_that_never_began_has_nothing_failed():
    assert "FAILED" not in closing.failure({})
