"""Pages: every example in Python runs as it stands, every command of the tutorial, and links lead somewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/reference/*.md")])


def blocks(page: Path, language: str) -> list[str]:
    """The blocks of code of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


EXAMPLES = [
    pytest.param(page, number, marks=pytest.mark.slow if "training.fit(" in code else ())
    for page in PAGES
    for number, code in enumerate(blocks(page, "python"))
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page, number", EXAMPLES, ids=lambda value: getattr(value, "stem", value))
def test_examples_run(page, number, monkeypatch, capsys):
    if page.stem == "architecture":
        pytest.skip("shows code of the project")
    monkeypatch.chdir(ROOT)
    exec(compile(blocks(page, "python")[number], str(page), "exec"), {})  # what a reader does with it
    assert capsys.readouterr().out


@pytest.mark.slow
def test_commands_of_the_tutorial_run(tmp_path):
    """In a folder with the photographs of the tests and the published lenses; it takes two minutes."""
    for name in ("docs", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    commands = "".join(blocks(ROOT / "docs/tutorial.md", "bash"))
    done = subprocess.run(
        ["bash", "-eu", "-c", commands], cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for name in ("doublet.png", "capture.png", "both.png", "doublet.zmx", "mine.yaml"):
        assert (tmp_path / name).stat().st_size > 1000, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target
