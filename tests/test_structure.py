"""The shape of the code: who may import whom, what stays free of torch, and what a digest of code covers."""

import ast
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tasklens.pipeline import digest
from tasklens.runtime import files

ROOT = Path(__file__).parents[1]
MODULES = sorted(p for package in digest.PACKAGES for p in (ROOT / package).rglob("*.py"))

# From the ground up: a module imports only from its own floor (its own package) and from the floors below.
FLOORS = [
    ("tasklens.runtime", "tasklens.materials", "tasklens.pipeline.digest"),
    ("tasklens.study",),
    ("tasklens.optics.lens", "tasklens.optics.view"),
    ("tasklens.optics.tracing",),
    ("tasklens.optics",),
    ("tasklens.imaging",),
    ("tasklens.recognition",),
    ("tasklens.design",),
    ("tasklens.report", "restoration"),
    ("tasklens.pipeline",),
]


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def room_of(module: str) -> tuple[int, str]:
    """Floor and room of a module: the longest entry that it belongs to."""
    rooms = [
        (len(r), floor, r) for floor, rooms in enumerate(FLOORS) for r in rooms if f"{module}.".startswith(f"{r}.")
    ]
    assert rooms, f"{module} has no floor: add it to FLOORS"
    return max(rooms)[1:]


def imports_of(path: Path) -> set[str]:
    found = digest.imports(ast.parse(path.read_text()))
    # `from tasklens.optics import psf` names the package as well: what counts is the module.
    return {name for name in found if not any(other.startswith(f"{name}.") for other in found)} - {"tasklens"}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_run_downward(path):
    module = name_of(path)
    if module == "tasklens":
        assert not imports_of(path)
        return
    floor, room = room_of(module)
    for imported in imports_of(path):
        below, other = room_of(imported)
        assert below < floor or other == room, f"{module} imports {imported}"


def test_modules_of_a_room_do_not_import_in_a_circle():
    graph = {name_of(path): imports_of(path) for path in MODULES}
    done: set[str] = set()
    while len(done) < len(graph):
        ready = {module for module, needs in graph.items() if module not in done and needs <= done}
        assert ready, f"a circle among {sorted(set(graph) - done)}"
        done |= ready


def test_only_the_stages_that_measure_import_restoration():
    users = {name_of(path) for path in MODULES if any(name.startswith("restoration") for name in imports_of(path))}
    assert {user for user in users if not user.startswith("restoration")} == {"tasklens.pipeline.stages.measure"}


@pytest.mark.parametrize("module", ["cli", "study", "jobs", "claims", "layout", "digest", "files"])
def test_parsing_a_study_needs_no_torch(module):
    """Each cluster job parses the Snakefile again: what it imports must stay light."""
    heavy = ("torch", "timm", "pandas", "numpy", "scipy", "matplotlib")
    code = f"import sys; import tasklens.{module}; print([m for m in {heavy!r} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("module", ["tables", "verdicts", "verification", "tails", "ablations", "regimes"])
def test_tables_need_no_torch(module):
    code = f"import sys, tasklens.report.{module}; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_holds_one_idea(path):
    assert path.stem not in ("utils", "util", "helpers", "common", "misc")
    assert len(path.read_text().splitlines()) < 300


# ---- digests of code


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the packages, and a function that edits it and takes the digest of a stage."""
    for package in digest.PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    monkeypatch.setattr(digest, "ROOT", tmp_path)

    def after(stage: str, path: str = "", old: str = "", new: str = "") -> str:
        if path:
            text = (tmp_path / path).read_text()
            assert old in text
            (tmp_path / path).write_text(text.replace(old, new, 1))
        digest.parse.cache_clear()
        digest.code_digest.cache_clear()
        return digest.code_digest(stages.STAGES[stage].function)

    yield after
    digest.parse.cache_clear()
    digest.code_digest.cache_clear()


READ_IMAGES = {"images", "reference", "design", "restore", "fine_tune", "reproduce"}
STAGES = (
    *READ_IMAGES,
    "psf",
    "tail",
    "table",
    "psf_tail",
    "verdicts",
    "ablation",
    "figure",
    "comparison",
    "certificate",
)


@pytest.mark.parametrize(
    "path, old, new",
    [
        ("tasklens/optics/psf.py", '"""Point spread', '"""Another docstring: point spread'),
        ("tasklens/optics/psf.py", "# Far rays", "# Rays that are far"),
        ("tasklens/optics/psf.py", "import torch\n", "\n\nimport torch\n"),
        ("tasklens/pipeline/stages/psf.py", '"""Trace the PSF', '"""Calculate the PSF'),
    ],
)
def test_words_do_not_change_a_digest(copy, path, old, new):
    """Comments, docstrings and blank lines rerun nothing."""
    before = {stage: copy(stage) for stage in STAGES}
    copy("psf", path, old, new)
    assert {stage: copy(stage) for stage in STAGES} == before


@pytest.mark.parametrize(
    "path, old, new, touched",
    [
        (
            "tasklens/optics/psf.py",
            "kernel_size // 2",
            "kernel_size // 3",
            {"design", "psf", "tail", "figure", "comparison", "certificate"},
        ),
        ("tasklens/imaging.py", '"reflect"', '"circular"', {"design", "restore", "fine_tune", "reproduce"}),
        ("tasklens/recognition/scenes.py", "NOISE * white", "white", READ_IMAGES),
        ("tasklens/design/constraints.py", ".clamp(min=0)", ".clamp(min=1)", {"design"}),
        ("tasklens/report/tables.py", "ddof=1", "ddof=0", {"table", "verdicts", "ablation", "comparison"}),
        ("restoration/nafnet.py", "chunk(2, dim=1)", "chunk(2, dim=-3)", {"restore", "fine_tune", "reproduce"}),
        ("restoration/training.py", "_GAIN_DB = 0.1", "_GAIN_DB = 0.2", {"restore"}),
        ("tasklens/pipeline/stages/psf.py", "grid.float()", "grid", {"psf"}),
        ("tasklens/pipeline/stages/figures.py", "Panel(title,", "Panel(title.upper(),", {"figure", "comparison"}),
        (
            "tasklens/report/bootstrap.py",
            "RESAMPLES = 10_000",
            "RESAMPLES = 10",
            {"verdicts", "ablation", "comparison"},
        ),
    ],
    ids=lambda v: v if isinstance(v, str) and "/" in v else "",
)
def test_code_changes_the_digests_of_the_stages_that_run_it(copy, path, old, new, touched):
    before = {stage: copy(stage) for stage in STAGES}
    copy("psf", path, old, new)
    found = {stage for stage in STAGES if copy(stage) != before[stage]}
    assert found == touched


def test_unknown_stage_raises():
    with pytest.raises(ValueError, match="bake"):
        digest.code_digest("tasklens.bake.run")


# ---- files


def test_a_file_is_written_whole(tmp_path):
    path = tmp_path / "deep" / "file.txt"
    files.write_text(path, "first")
    files.write_text(path, "second")
    assert path.read_text() == "second"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("before", [None, "old"])
def test_a_failing_writer_leaves_things_as_they_were(tmp_path, before):
    """No half-written file, no temporary; an older file stays."""
    path = tmp_path / "file.txt"
    if before is not None:
        path.write_text(before)
    with pytest.raises(RuntimeError, match="halfway"), files.replacing(path) as temporary:
        temporary.write_text("half")
        assert temporary.parent == path.parent  # else the rename would not be atomic
        raise RuntimeError("halfway")
    assert [p.name for p in tmp_path.iterdir()] == ([] if before is None else ["file.txt"])
    assert before is None or path.read_text() == before


def test_a_killed_writer_leaves_nothing_that_looks_finished(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from tasklens.runtime.files import replacing\n"
        "with replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half'); os.kill(os.getpid(), 9)"
    )
    path = tmp_path / "file.txt"
    done = subprocess.run([sys.executable, "-c", code, str(path)], env=os.environ)
    assert done.returncode == -signal.SIGKILL and not path.exists()


def test_rows_keep_all_columns(tmp_path):
    """Columns in order of appearance, gaps where a row has none."""
    files.write_rows(tmp_path / "rows.csv", [{"a": 1, "b": 0.1}, {"a": 2, "c": "x,y"}])
    assert (tmp_path / "rows.csv").read_text() == 'a,b,c\n1,0.1,\n2,,"x,y"\n'


def test_tensors_keep_values_and_metadata(tmp_path):
    import torch

    tensors = {"a": torch.randn(2, 3, generator=torch.Generator().manual_seed(0)).T, "n": torch.arange(3)}
    files.write_tensors(tmp_path / "t.safetensors", tensors, {"fields": [[0, 0.5]], "name": "x"})
    found, notes = files.read_tensors(tmp_path / "t.safetensors")
    assert found.keys() == tensors.keys() and all(torch.equal(found[k], tensors[k]) for k in tensors)
    assert notes == {"fields": [[0, 0.5]], "name": "x"}


def test_an_unchanged_text_is_not_touched(tmp_path):
    """Its modification time is what a workflow would look at."""
    path = tmp_path / "study.yaml"
    files.write_if_changed(path, "a")
    os.utime(path, (1, 1))
    files.write_if_changed(path, "a")
    assert path.stat().st_mtime == 1
    files.write_if_changed(path, "b")
    assert path.stat().st_mtime > 1 and path.read_text() == "b"
