"""The programs of docs/results: they publish tables, recompute intervals, decompose gains and fill pages."""

import math
import re
import shutil
from functools import cache
from pathlib import Path

import pandas
import pytest
from examples import load_script, write
from random_answers import PROBABILITY, claim, random_answers

from tasklens.study.claims import OVER_IMAGE_QUALITY, OVER_IMAGING1, Claims
from tasklens.study.report import answers_file

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
SMALLEST = RESULTS / "replication/images.seed=16"  # one seed


recompute, decomposition, pages, publish = (
    load_script(RESULTS / f"{name}.py") for name in ("recompute", "decomposition", "pages", "publish")
)
DOUBLETS = Claims(
    study="doublets",
    claims=(claim(OVER_IMAGE_QUALITY, *(f"doublet-{name}" for name in reversed(PROBABILITY))),),
    seeds=(0, 1),
)


@pytest.mark.slow
def test_published_intervals_are_those_of_the_published_answers(monkeypatch):
    monkeypatch.setattr("sys.argv", ["recompute.py"])
    assert recompute.main() == 0
    assert len(list(RESULTS.rglob("*.npz"))) >= 5


def test_a_changed_interval_is_noticed(tmp_path):
    """Of three claims, each with another wrong number."""
    for name in ("verdicts.npz", "verdicts.csv"):
        shutil.copy(SMALLEST / name, tmp_path / name)
    assert recompute.table_differences(tmp_path / "verdicts.npz") == []
    table = pandas.read_csv(tmp_path / "verdicts.csv")
    for row, column in enumerate(("difference", "low", "high")):
        table.loc[row, column] += 0.01
    table.to_csv(tmp_path / "verdicts.csv", index=False)
    assert len(recompute.table_differences(tmp_path / "verdicts.npz")) == 3


def test_a_changed_comparison_is_noticed(tmp_path):
    """Of several baselines, the comparison is with the best in minival, as in the published verdict."""
    table = pandas.read_csv(SMALLEST / "verdicts.csv")
    row = table[table["claim"].str.contains("least squares")].iloc[0]
    claims, _ = answers_file.read(SMALLEST / "verdicts.npz")
    baselines = next(c.baselines for c in claims.claims if (c.text, c.lens) == (row["claim"], row["lens"]))
    shutil.copy(SMALLEST / "verdicts.npz", tmp_path)
    columns = ("lens", "classifier", "difference", "low", "high")
    quoted = pandas.DataFrame([row[[*columns]]]).assign(answers="verdicts.npz", baseline=" ".join(baselines))
    path = tmp_path / "comparisons.csv"
    quoted.to_csv(path, index=False)
    recomputed = recompute.comparisons(path)
    assert recompute.list_differences(path, recomputed) == [] and len(baselines) > 1
    for column in ("difference", "low", "high"):
        quoted.assign(**{column: quoted[column] + 0.2}).to_csv(path, index=False)
        assert len(recompute.list_differences(path, recomputed)) == 1


def test_a_changed_number_is_noticed_and_written_anew(tmp_path, monkeypatch, capsys):
    """With one decimal."""
    (tmp_path / "comparisons.csv").write_text("answers,lens,baseline,classifier,difference,low,high\n")
    published = pandas.read_csv(RESULTS / "numbers.csv").head(1)
    source = RESULTS / published["source"].item()
    shutil.copy(source, tmp_path)
    published = published.assign(source=source.name)
    published.assign(value=published["value"] + 0.2).to_csv(tmp_path / "numbers.csv", index=False)
    monkeypatch.setattr(recompute, "FOLDER", tmp_path)
    monkeypatch.setattr("sys.argv", ["recompute.py"])
    assert recompute.main() == 1 and ": 1 differences" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["recompute.py", "--write"])
    assert recompute.main() == 0 and ": 0 differences" in capsys.readouterr().out
    assert pandas.read_csv(tmp_path / "numbers.csv")["value"].item() == published["value"].item()


STUDY_PAGES = [
    str(path.relative_to(ROOT)) for path in sorted(RESULTS.glob("*/README.md")) if pages.BLOCK.search(path.read_text())
]
INTERVAL = re.compile(r"(-?\d+\.\d)(?: points?)?,? \(?(-?\d+\.\d) to (-?\d+\.\d)")  # or 0.7, 0.6 to 0.9


@cache
def published() -> set[tuple[float, ...]]:
    """Differences with their intervals in all published tables, to one decimal."""
    intervals = set()
    for path in RESULTS.rglob("*.csv"):
        table = pandas.read_csv(path)
        if {"difference", "low", "high"} <= {*table}:
            for row in table[["difference", "low", "high"]].dropna().itertuples(index=False):
                intervals.add(tuple(round(number, 1) for number in row))
    return intervals


QUOTING = [
    "README.md",
    "docs/results.md",
    "docs/fidelity.md",
    "docs/notes/predictions.md",
    "docs/results/predictions.csv",
]


@pytest.mark.parametrize("page", [*QUOTING, *STUDY_PAGES])
def test_every_interval_of_a_page_is_in_a_published_table(page):
    quoted = INTERVAL.findall((ROOT / page).read_text())
    assert [numbers for numbers in quoted if tuple(map(float, numbers)) not in published()] == []
    assert quoted or page == "README.md"


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_every_number_in_a_table_of_a_page_has_a_source(page):
    """Numbers with a decimal, outside of intervals; `recompute.py` compares the list with its sources."""
    listed = {f"{value:.1f}" for value in pandas.read_csv(RESULTS / "numbers.csv")["value"]}
    text = pages.BLOCK.sub("", (ROOT / page).read_text())  # without tables that `pages.py` writes
    rows = [line for line in text.splitlines() if line.startswith("|")]
    numbers = {number for row in rows for number in re.findall(r"(?<![\d./-])\d+\.\d(?![\d.])", INTERVAL.sub("", row))}
    assert numbers <= listed, numbers - listed
    assert numbers or page == "README.md"


def test_the_decomposition_adds_up(tmp_path, monkeypatch):
    """Each difference is that of the accuracies of two steps, with and without the corner, whose share is a ninth."""
    (tmp_path / "doublets").mkdir()
    answers_file.write(tmp_path / "doublets/verdicts.npz", DOUBLETS, random_answers(DOUBLETS))
    monkeypatch.setattr(decomposition, "FOLDER", tmp_path)
    monkeypatch.setattr("sys.argv", ["decomposition.py", "doublets"])
    assert decomposition.main() == 0
    table = pandas.read_csv(tmp_path / "decomposition.csv")
    by_step = table.drop_duplicates(["step", "fields"])
    steps = by_step[by_step["fields"] == "all fields"].set_index("step")
    quality = ["least squares", "squared error or PSNR", "image correlation"]
    assert list(steps.index) == [step for step in decomposition.STEPS if "corner" not in step and "filter" not in step]
    assert steps.loc[quality[1:], "difference"].tolist() == pytest.approx(steps["accuracy"].diff().tolist()[1:3])
    gains = steps.drop(quality)
    best = steps.loc["image correlation", "accuracy"]  # the best lens for image quality in both seeds
    assert gains["difference"].tolist() == pytest.approx((gains["accuracy"] - best).tolist())
    assert (gains["lowest"] < gains["difference"]).all() and (gains["difference"] < gains["highest"]).all()
    inner = by_step[by_step["fields"] == "without the corner"].set_index("step")
    spots = table[(table["compared_with"] == "least squares") & (table["fields"] == "all fields")].set_index("step")
    least_squares = steps.loc["least squares", "accuracy"]
    assert spots["difference"].tolist() == pytest.approx((spots["accuracy"] - least_squares).tolist())
    assert len(spots) == 5  # the squared error and four kinds of task
    answers = random_answers(DOUBLETS)
    corner = [100 * answers.correct("doublet-tasklens", "small", seed).iloc[:, -1].mean() for seed in (0, 1)]
    task = "task, from flat plates"
    assert (9 * steps.loc[task, "accuracy"] - sum(corner) / 2) / 8 == pytest.approx(inner.loc[task, "accuracy"])
    labels = re.findall(r">([^<>]+)</text>", (tmp_path / "decomposition.svg").read_text())
    assert {*list(decomposition.STEPS)[5:]} <= {*labels}


def test_the_published_decomposition_is_that_of_the_published_answers(monkeypatch, tmp_path):
    """Of a small study; `decomposition.py --check` compares all of them."""
    monkeypatch.setattr("sys.argv", ["decomposition.py", "fine_quadruplets", "--check"])
    assert decomposition.main() == 0
    table = pandas.read_csv(RESULTS / "decomposition.csv")
    assert not decomposition.differs(
        "fine_quadruplets", table[table["study"] == "fine_quadruplets"].reset_index(drop=True)
    )
    table.loc[(table["study"] == "fine_quadruplets") & table["difference"].notna(), "low"] += 1e-3
    table = table[table["study"] == "fine_quadruplets"].reset_index(drop=True)
    assert decomposition.differs("fine_quadruplets", table)


def test_without_lenses_for_image_quality_the_task_is_compared_with_least_squares(tmp_path):
    path = tmp_path / "verdicts.npz"
    claims = Claims(study="s", claims=(claim(OVER_IMAGING1, "doublet-tasklens", "doublet-imaging2"),), seeds=(0,))
    answers_file.write(path, claims, random_answers(claims))
    table = decomposition.rows_of_file("s", path).set_index("step")
    assert {*table.loc["task, from flat plates", "compared_with"]} == {"least squares"}


def test_fresh_images_are_one_study_with_an_interval_over_them(tmp_path, monkeypatch):
    """The mean over the points of a sweep, with Student's interval, from files of a point each."""
    seeds = {f"fresh/images.seed={seed}": (seed,) for seed in DOUBLETS.seeds}
    for folder, of_folder in {**seeds, "both": DOUBLETS.seeds}.items():
        (tmp_path / folder).mkdir(parents=True)
        claims = DOUBLETS.model_copy(update={"seeds": of_folder})
        answers_file.write(tmp_path / folder / "verdicts.npz", claims, random_answers(claims))
    monkeypatch.setattr(decomposition, "FOLDER", tmp_path)
    monkeypatch.setattr(decomposition, "rows_of_file", cache(decomposition.rows_of_file))
    keys = ["fields", "step"]
    fresh, both = (decomposition.rows(s).drop_duplicates(keys).set_index(keys) for s in ("fresh", "both"))
    pandas.testing.assert_frame_equal(*(frame[["accuracy", "difference"]].sort_index() for frame in (fresh, both)))
    step = ("all fields", "task, from an image-quality lens")
    first, second = (
        decomposition.rows_of_file("fresh", path).drop_duplicates(keys).set_index(keys).loc[step, "difference"]
        for path in sorted(tmp_path.glob("fresh/*/verdicts.npz"))
    )
    assert fresh.loc[step, "high"] - fresh.loc[step, "low"] == pytest.approx(12.706 * abs(first - second), rel=1e-4)
    p_of_one = 1 - 2 / math.pi * math.atan(abs(first + second) / abs(first - second))  # Student's t of two points
    assert p_of_one <= fresh.loc[step, "p"] <= 4 * p_of_one and fresh["p"].count() == 4


def test_published_files_replace_those_of_before(here, monkeypatch):
    """Tables, answers and the lenses of the first seed, also of the points of a sweep; a page by hand remains."""
    contents = {"tables/table1.csv": "new", "tables/answers.csv": "", "effort.md": "", "answer.svg": ""}
    contents |= {f"lenses/doublet-a/seed{seed}/{name}": str(seed) for seed in (1, 0) for name in ("lens.yaml", "a.zmx")}
    contents |= {
        "gain=2/tables/table1.csv": "point",
        "elements=doublet/tables/table1.csv": "of doublets",
        "lenses/a_variant/seed1/lens.yaml": "",
        "study.yaml": "seeds: [1, 0]",
        "report.html": "",
    }
    before = {"published/known/README.md": "page", "published/known/old.csv": ""}
    for name, content in ({f"results/known/{name}": content for name, content in contents.items()} | before).items():
        write(here / name, content)
    monkeypatch.setattr(publish, "FOLDER", here / "published")
    monkeypatch.setattr("sys.argv", ["publish.py", "known", "--lenses"])
    publish.main()
    files = [path for path in (here / "published/known").rglob("*") if path.is_file()]
    names = {str(path.relative_to(here / "published/known")) for path in files}
    tables = {"table1.csv", "effort.md", "answer.svg", "gain=2/table1.csv"}
    assert names == {"README.md", "lenses/doublet-a.yaml", "lenses/a.zmx"} | tables
    assert (here / "published/known/lenses/doublet-a.yaml").read_text() == "1"
    (here / "results/known/study.yaml").write_text("seeds: [2]")
    with pytest.raises(SystemExit, match="no Zemax files of seed 2; the published lenses remain"):
        publish.main()
    assert (here / "published/known/lenses/doublet-a.yaml").exists()
    monkeypatch.setattr("sys.argv", ["publish.py", "unknown"])
    with pytest.raises(SystemExit):
        publish.main()
    monkeypatch.setattr("sys.argv", ["publish.py", "known", "--to", "other", "--elements", "doublet"])
    publish.main()
    assert (here / "published/other/table1.csv").read_text() == "of doublets"


def test_the_tables_of_pages_are_those_of_their_files(monkeypatch):
    monkeypatch.setattr("sys.argv", ["pages.py", "--check"])
    assert STUDY_PAGES and pages.main() == 0
