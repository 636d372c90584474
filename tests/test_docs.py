"""Documentation: every Python example and every command of the tutorial runs, and links have targets."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from examples import cooke_file, random_images, trained_resnet, write_photographs

from tasklens.cli.app import main
from tasklens.optics.io import zemax
from tasklens.optics.tolerancing import yields

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/notes/*.md"), *ROOT.glob("docs/reference/*.md")]
)


def blocks(page: Path, language: str) -> list[str]:
    """Code blocks of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


EXAMPLES = [
    pytest.param(page, number, marks=pytest.mark.slow if "training.fit(" in code else ())
    for page in PAGES
    if page.stem != "architecture"  # code of the project
    for number, code in enumerate(blocks(page, "python"))
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page, number", EXAMPLES, ids=lambda value: getattr(value, "stem", value))
def test_examples_run(page, number, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exec(compile(blocks(page, "python")[number], str(page), "exec"), {})  # as a reader does
    assert capsys.readouterr().out


@pytest.mark.slow
def test_commands_of_the_tutorial_run(here, few_rays):
    """In a folder with the test photographs and the published lenses; the search for a lens is brief."""
    for name in ("docs", "tests"):
        (here / name).symlink_to(ROOT / name)
    for line in "".join(blocks(ROOT / "docs/tutorial.md", "bash")).splitlines():
        brief = "--set evaluations=100 --set starts=3" if line.startswith("tasklens design") else ""
        assert main([*line.split()[1:], *brief.split()]) == 0, line
    for name in ("doublet.png", "capture.png", "both.png", "doublet.zmx", "mine.yaml"):
        assert (here / name).stat().st_size > 1000, name
    subprocess.run([Path(sys.executable).parent / "tasklens", "lens", "show", "doublet.zmx"], check=True)


SMALL = "--size 32 --kernel-size 11 --network test_resnet"
DESCENT = "--set rays=16 --set batch_size=2 --set descents.0.steps=1 --force"
FLAT = "--elements COC --start flat --set descents.0.lenses=1 --set descents.1.steps=1 --set descents.2.steps=1"
QUICK = {  # options that make a command quick, by the beginning of the command
    "tasklens rank catalogue --images photographs --network resnet18": f"{SMALL} --max-images 20 --scale",
    "tasklens design --method task": f"{SMALL} {DESCENT} {FLAT}",
    "tasklens design --start my.zmx --method task": f"{SMALL} {DESCENT}",
    "tasklens design --start my.zmx --method contrast": "--set descents.0.steps=2 --limit max_track=70 --force",
    "tasklens design --start": "--set descents.0.steps=2 --force",
    "tasklens lens tolerance": "--lenses 10 --wavelengths 0.55",
    "tasklens lens analyse": "--rays 64",
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_commands_of_the_how_to_run(here, monkeypatch, few_rays):
    """Commands for the user's own lens: a Cooke triplet, few steps, and a network that tells dark from bright."""
    monkeypatch.setattr(yields, "_RAYS", 32)
    cooke_file(here / "my.zmx", wavelengths_um=(0.65, 0.55, 0.47))
    (here / "MAKER.AGF").write_text("NM MINE 5 0 1.5 50\nCD 1.5 0 0\nLD 0.4 0.8\n")
    (here / "catalogue").mkdir()
    shutil.copy(here / "my.zmx", here / "catalogue")
    images = random_images(120, 40, 2, seed=0)
    write_photographs(here / "photographs", images, ("cat", "dog"))
    trained_resnet(here / "mine.safetensors", images, epochs=2, learning_rate=1e-3, batch_size=12)
    lines = [line for block in blocks(ROOT / "docs/how-to.md", "text") for line in block.splitlines()]
    commands = [(line, quick) for line in lines for start, quick in QUICK.items() if line.startswith(start)]
    done = set()
    for line, quick in commands:
        if line not in done:  # by the first, longest matching beginning
            done.add(line)
            assert main([*line.split()[1:], *quick.split()]) == 0, line
    assert len(done) == 7 and (here / "mine.html").exists() and Path("results/ranking/ranking.html").exists()
    assert zemax.read(here / "better.zmx").lens.stop == 4


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_the_page_of_keys_has_all_keys_of_a_study(monkeypatch):
    """`python tools/study_keys.py` writes it."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    import study_keys

    assert study_keys.PAGE.read_text(encoding="utf-8") == study_keys.page()
