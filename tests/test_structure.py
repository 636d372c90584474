"""The structure of the code: imports run downward, light parts need no torch, and no module or function is long."""

import ast
import re
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from rules import MODULES, ROOT, name_of, workflow

from tasklens.study.run import digest

# From the ground up: a module imports only from its own room (its package) and from the floors below. A package's
# own modules belong to its entry, the modules of a subpackage to the entry of the subpackage.
FLOORS = [
    ("tasklens.runtime", "tasklens.fields"),
    ("tasklens.materials",),
    ("tasklens.settings",),
    ("tasklens.optics",),  # rays, aspheres, surface, lens, view, psf
    ("tasklens.optics.tracing",),
    ("tasklens.optics.analysis",),
    ("tasklens.optics.tolerancing",),
    ("tasklens.optics.io",),
    ("tasklens.camera",),
    ("tasklens.recognition",),
    ("tasklens.design",),
    ("tasklens.show", "restoration"),
    ("tasklens.api",),
    ("tasklens.study",),
    ("tasklens.study.report",),
    ("tasklens.study.jobs",),
    ("tasklens.study.run",),
    ("tasklens.cli",),
]


def room_of(module: str) -> tuple[int, str]:
    """Floor and room of a module: the longest entry that it belongs to."""
    rooms = [
        (len(r), floor, r) for floor, rooms in enumerate(FLOORS) for r in rooms if f"{module}.".startswith(f"{r}.")
    ]
    assert rooms, f"{module} has no floor: add it to FLOORS"
    return max(rooms)[1:]


def imports_of(path: Path) -> set[str]:
    imported = digest.imports(ast.parse(path.read_text()))
    # `from tasklens.optics import psf` names the package as well: only the module counts.
    return {name for name in imported if not any(other.startswith(f"{name}.") for other in imported)} - {"tasklens"}


IMPORTS = {name_of(path): imports_of(path) for path in MODULES}


def test_imports_run_downward():
    for module, imported in IMPORTS.items():
        if module == "tasklens":
            assert not imported
            continue
        floor, room = room_of(module)
        for name in imported:
            below, other = room_of(name)
            assert below < floor or other == room, f"{module} imports {name}"


def test_modules_of_a_room_do_not_import_in_a_circle():
    TopologicalSorter(IMPORTS).prepare()  # otherwise a CycleError, which names the modules


def test_only_the_jobs_that_measure_import_restoration():
    users = {module for module, imported in IMPORTS.items() if any(name.startswith("restoration") for name in imported)}
    outside_users = {user for user in users if not user.startswith("restoration")}
    assert outside_users == {f"tasklens.study.jobs.{name}" for name in ("restore", "classify", "capture")}


def imported_with(modules: list[str], heavy: tuple[str, ...]) -> str:
    """Import the modules in turn in a new process; return the first one that loads heavy packages, and these."""
    code = (
        f"import importlib, sys\nfor name in {modules!r}:\n    importlib.import_module(name)\n"
        f"    loaded = [m for m in {heavy!r} if m in sys.modules]\n    if loaded: sys.exit(f'{{name}}: {{loaded}}')"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr


def test_parsing_a_study_needs_no_torch():
    """Each cluster job parses the Snakefile again: what it imports must stay light."""
    pipeline = [f"tasklens.study.run.{name}" for name in ("digest", "changes", "forecast", "snakemake_internals")]
    study = [name_of(path) for path in (ROOT / "tasklens" / "study").glob("*.py")]
    others = [
        "tasklens",
        "tasklens.cli.app",
        "tasklens.runtime.files",
        "tasklens.runtime.job",
        "tasklens.materials.catalogues",
    ]
    heavy = ("torch", "timm", "pandas", "numpy", "scipy", "matplotlib")
    assert imported_with([*others, *study, *pipeline], heavy) == ""
    assert "pandas" in imported_with(["tasklens.study.report.tables"], heavy)  # it would be seen


def test_tables_need_no_torch():
    names = ("tables", "verdicts", "verification", "ablation_table", "measurements")
    modules = [f"tasklens.study.report.{name}" for name in names]
    assert imported_with([*modules, "tasklens.show.bootstrap", "tasklens.show.publish"], ("torch", "matplotlib")) == ""


NETWORKS = ("timm", "torchvision", "kornia", "torch._dynamo")


UNUSED = {  # by jobs
    "images": (*NETWORKS, "numba", "scipy.fft", "pandas", "matplotlib"),
    "design_lens": ("pandas", "matplotlib"),
    "capture": ("numba", "matplotlib", "torchvision.transforms.v2"),
    "psf_tail": (*NETWORKS, "scipy.fft", "scipy.optimize", "matplotlib"),
    "certify": (*NETWORKS, "scipy.fft", "scipy.optimize", "matplotlib.pyplot"),
    "lens_figures": (*NETWORKS, "scipy.fft", "scipy.optimize", "matplotlib.pyplot"),
    "restore": ("numba", "pandas", "matplotlib"),
    "produce": ("torchvision.transforms.v2", "matplotlib"),
    "train_classifier": ("kornia", "numba", "scipy.fft", "pandas", "matplotlib", "torchvision.transforms.v2"),
    "classify": ("numba", "pandas", "matplotlib", "torchvision.transforms.v2"),
}


CHAINS = [  # each job leaves out at least what the next ones do, so that one process imports them in turn
    ["images", "train_classifier", "classify", "capture", "produce"],
    ["restore", "design_lens"],
    ["psf_tail", "certify", "lens_figures"],
]


@pytest.mark.slow
def test_jobs_import_what_they_use():
    """Imports took nine tenths of the time of a short job. Chains are imported by forks of a process with torch."""
    assert {job for chain in CHAINS for job in chain} == UNUSED.keys()
    code = (
        f"import importlib, os, sys, torch\nunused = {UNUSED!r}\nfor jobs in {CHAINS!r}:\n    if not os.fork():\n"
        "        for job in jobs:\n            importlib.import_module(f'tasklens.study.jobs.{job}')\n"
        "            if loaded := [m for m in unused[job] if m in sys.modules]: sys.exit(f'{job}: {loaded}')\n"
        "        sys.exit()\n    os.wait()"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr == ""


def test_a_module_holds_one_idea():
    stems = [path.stem for path in MODULES if path.stem != "__init__"]
    assert not {*stems} & {"utils", "util", "helpers", "common", "misc"}
    assert [name for name, count in Counter(stems).items() if count > 1] == []
    assert [name_of(path) for path in MODULES if len(path.read_text().splitlines()) >= 300] == []


TEST_CODE = sorted((ROOT / "tests").rglob("*.py"))


def test_no_test_module_is_imported_by_another():
    """Shared code of tests is in modules without the prefix `test_`."""
    imports = []
    for path in TEST_CODE:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imports += [f"{path.name} imports {name}" for name in modules if name.split(".")[-1].startswith("test_")]
    assert imports == []


def test_functions_are_short():
    """None has more than 12 parameters or 80 lines."""
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                parameters = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                count = sum(parameter.arg not in ("self", "cls") for parameter in parameters)
                assert count <= 12, f"{node.name} in {path} has {count} parameters"
                assert node.end_lineno - node.lineno < 80, f"{node.name} in {path}"


IMPORT = re.compile(r"^from (\w[\w.]*) import ([\w ,]+)$", re.M)


@pytest.mark.parametrize("path", [ROOT / "Snakefile", *sorted(ROOT.glob("workflow/rules/*.smk"))], ids=lambda p: p.name)
def test_names_in_rules_exist(path):
    """Of our modules: a handler that runs after the plan fails too late."""
    workflow()  # imports what the rules name
    text = path.read_text()
    common = "".join(file.read_text() for file in (ROOT / "Snakefile", ROOT / "workflow/rules/common.smk"))
    for package, names in IMPORT.findall(common + text):
        for name, _, alias in (part.strip().partition(" as ") for part in names.split(",")):
            module = sys.modules.get(f"{package}.{name}")
            if module and package.startswith("tasklens"):
                used = re.findall(rf"(?<![\w./]){alias or name}\.(\w+)", text)
                assert [member for member in used if not hasattr(module, member)] == []
