"""The last words of a run: the study's answer, where its results are, what failed, and what to type next."""

import pytest
from examples import tiny_study, write

from tasklens.pipeline import closing, report_jobs, runs  # noqa: F401  declares the stages
from tasklens.report import answer
from tasklens.study.loading import parse

FOLDER = "results/tiny"
COLUMNS = "table,claim,lens,baseline,classifier,difference,low,high,p_holm,seeds,verdict,reason\n"
CLAIMS = (
    ("table1", "more accurate than imaging1", "small", 3.56, "suggests +3.6 points"),
    ("table1", "more accurate than the best design by least squares", "small", -2.2, "suggests -2.2 points"),
    ("table1", "more accurate than the best design by image error", "small", 0.4, "undecided"),
    ("table1", "more accurate than imaging1", "other", 9.9, "suggests +9.9 points"),
    ("table3", "at least as accurate as end-to-end design", "small", 1.0, "undecided"),
)
SENTENCE = (
    "singlet-tasklens is more accurate than imaging1 (+3.6); less accurate than the best design by least squares "
    "(-2.2); as accurate, as far as can be told, as the best design by image error (+0.4) points"
)


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def verdicts(*claims, seeds: int = 1) -> None:
    rows = (
        f"{table},{text},singlet-tasklens,x,{classifier},{value},,,,{seeds},{verdict},"
        for table, text, classifier, value, verdict in claims
    )
    write(f"{FOLDER}/tables/verdicts.csv", COLUMNS + "\n".join(rows) + "\n")


def study(**changes):
    return parse(tiny_study() | changes)


def run_of(*labels: str) -> runs.Run:
    """A run of five minutes, all of whose jobs are done."""
    made = runs.Run("tiny", FOLDER, 1, {label: runs.Job(label.split("/")[0], runs.DONE) for label in labels})
    made.started -= 300
    return made


def test_the_answer_is_a_sentence_for_each_lens(place):
    """Of the first table and network alone, by what can be told; one seed suggests."""
    verdicts(*CLAIMS)
    assert answer.sentences(place / FOLDER / "tables/verdicts.csv") == [f"{SENTENCE} [1 seed: a suggestion]."]
    verdicts(*((*claim[:4], claim[4].replace("suggests ", "")) for claim in CLAIMS), seeds=5)
    assert answer.sentences(place / FOLDER / "tables/verdicts.csv") == [f"{SENTENCE}."]
    verdicts()
    assert answer.sentences(place / FOLDER / "tables/verdicts.csv") == []


def test_a_study_that_has_verdicts_gives_its_answer():
    """With jobs and duration, the page, and the next commands, which take the study as it was run."""
    verdicts(*CLAIMS)
    write(f"{FOLDER}/report.html", "")
    run = run_of("design/a", "verdicts")
    run.finish()
    lines = closing.success(study(), run).splitlines()
    assert "Study tiny: 2 jobs in 5 min." in lines and f"{SENTENCE} [1 seed: a suggestion]." in lines
    assert lines[lines.index(f"Results: {FOLDER}/") + 1].strip() == f"{FOLDER}/report.html"
    commands = [line for line in lines if line.startswith("  snakemake")]
    assert len(commands) == 3 and all(f"--configfile {FOLDER}/study.yaml" in line for line in commands)
    assert "--config 'seeds=[0, 1, 2, 3, 4]'" in commands[-1]
    assert "seeds=" not in closing.success(study(seeds=[0, 1, 2, 3, 4]), run)


def test_a_run_that_made_no_verdicts_does_not_repeat_old_ones():
    """A drawing alone; where nothing was to be done, the answer stands."""
    verdicts(*CLAIMS)
    run = run_of("certificate/a")
    run.jobs["certificate/a"].result = f"{FOLDER}/lenses/a/certificate.md"
    run.finish()
    said = closing.success(study(), run)
    assert "accurate" not in said and f"  {FOLDER}/lenses/a/certificate.md" in said.splitlines()
    assert SENTENCE in closing.success(study(), None)


def test_without_verdicts_all_tables_come_next():
    run = run_of("design/a")
    run.finish()
    said = closing.success(study(), run)
    assert "accurate" not in said and f"Results: {FOLDER}/" in said
    assert f"snakemake -j2 tables --configfile {FOLDER}/study.yaml" in said and "verify" not in said


def test_a_failed_run_says_what_failed_and_how_to_go_on():
    """Each failed job with its last word and its log; and tables of what there is."""
    run = run_of("images", "design/a", "design/b", "table/table1")
    run.jobs["table/table1"].state = runs.WAITING
    run.end("design/a", runs.FAILED, 3.0, "tasklens: no such file")
    run.end("design/b", runs.FAILED, 3.0)
    lines = closing.failure(study(), run).splitlines()
    assert "Study tiny: 1 of 4 jobs done." in lines
    at = lines.index("FAILED  design a: tasklens: no such file")
    assert lines[at + 1].strip() == f"{FOLDER}/logs/design/a.log"
    assert "FAILED  design b: no word in its log" in lines
    assert any("--keep-going" in line for line in lines)
    assert lines[-1].endswith(f"tasklens run table {FOLDER}/study.yaml table1 --partial")


def test_a_run_that_never_began_has_nothing_failed():
    assert "FAILED" not in closing.failure(study(), None)
