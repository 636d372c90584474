"""Budgets of code, pages and data of the tests: whoever raises one decides that the program grows."""

import re
from pathlib import Path

import pytest
from reference_files import SHIPPED

ROOT = Path(__file__).parents[1]
BUDGETS = {  # by unit and files; the aim of the next version in parentheses
    ("lines", "tasklens/**/*.py restoration/**/*.py"): 29_510,  # (25 000)
    ("lines", "workflow/**/*.smk workflow/**/*.py Snakefile"): 1_400,
    ("lines", "tests/**/*.py"): 21_770,  # (19 500)
    ("files", "tasklens/**/*.py restoration/**/*.py"): 245,  # (230)
    ("words", "README.md"): 800,
    ("words", "docs/*.md"): 13_200,
    ("words", "docs/results.md"): 1_500,
    ("words", "docs/fidelity.md"): 700,
    ("words", "docs/results/existing_lenses.md"): 500,
    ("words", "docs/notes/*.md"): 4_000,
    ("words", "CHANGELOG.md"): 800,
}
WORD = re.compile(r"\S*\w\S*")  # bars and rules of tables are no words


@pytest.mark.parametrize("unit, files", BUDGETS)
def test_sizes_keep_their_budgets(unit, files):
    """A budget is not far above its size, so that it holds."""
    texts = [path.read_text(encoding="utf-8") for pattern in files.split() for path in ROOT.glob(pattern)]
    counts = {
        "files": len(texts),
        "lines": sum(text.count("\n") for text in texts),
        "words": sum(len(WORD.findall(text)) for text in texts),
    }
    budget = BUDGETS[unit, files]
    assert 0.9 * budget < counts[unit] <= budget, f"{counts[unit]} {unit} in {files}; the budget is {budget}"


def test_data_of_the_tests_are_small_and_have_a_source():
    files = [path for path in SHIPPED.rglob("*") if path.is_file()]
    sources = (SHIPPED / "SOURCES.md").read_text()
    assert [path.name for path in files if path.name != "SOURCES.md" and f"{path.name}`" not in sources] == []
    assert sum(path.stat().st_size for path in files) < 600_000
