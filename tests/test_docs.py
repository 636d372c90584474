"""Pages: every example in Python runs as it stands, every command of the tutorial, and links lead somewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import timm
from examples import cooke_triplet
from PIL import Image
from safetensors.torch import save_file

from tasklens.cli.app import main
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription

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


QUICK = {  # options that make a command of the page quick, by its beginning
    "tasklens design --start my.zmx --method task": "--size 32 --kernel-size 11 --set rays=16 --set batch_size=2 "
    "--set descents.0.steps=1 --force",
    "tasklens design --start": "--set descents.0.steps=2 --force",
    "tasklens lens tolerance": "--lenses 10",
    "tasklens lens analyse": "--rays 64",
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_commands_of_the_how_to_run(tmp_path, monkeypatch):
    """Those for a lens of one's own, with a Cooke triplet, few steps, and a network of random weights."""
    monkeypatch.chdir(tmp_path)
    fields = ("angle_deg", ((0.0, 0.0), (0.0, 20.0)))
    zemax.write(tmp_path / "my.zmx", Prescription(cooke_triplet(), "", None, None, fields, (0.65, 0.55, 0.47), 1))
    (tmp_path / "MAKER.AGF").write_text("NM MINE 5 0 1.5 50\nCD 1.5 0 0\nLD 0.4 0.8\n")
    for name in ("cat", "dog"):
        (tmp_path / "photographs" / name).mkdir(parents=True)
        for k in range(4):
            Image.new("RGB", (40, 40), (60 * k, 90, 120)).save(tmp_path / "photographs" / name / f"{k}.png")
    save_file(timm.create_model("resnet18", num_classes=2).state_dict(), tmp_path / "mine.safetensors")
    lines = [line for block in blocks(ROOT / "docs/how-to.md", "text") for line in block.splitlines()]
    commands = [(line, quick) for line in lines for start, quick in QUICK.items() if line.startswith(start)]
    done = set()
    for line, quick in commands:
        if line not in done:  # by its first, longest beginning
            done.add(line)
            assert main([*line.split()[1:], *quick.split()]) == 0, line
    assert len(done) == 5 and zemax.read(tmp_path / "better.zmx").lens.stop == 4


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target
