"""The structure of the code: allowed imports, modules without torch, and what a digest of code covers."""

import ast
import re
import shutil
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from rules import rule_names, workflow

from tasklens.study.run import digest

ROOT = Path(__file__).parents[1]
MODULES = sorted(p for package in digest.PACKAGES for p in (ROOT / package).rglob("*.py"))

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


def test_the_library_reports_its_own_errors():
    for path in MODULES:
        module = name_of(path)
        if not module.startswith(("tasklens.study", "tasklens.cli")):
            assert "StudyError" not in path.read_text(), module


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
    "drawing": (*NETWORKS, "scipy.fft", "scipy.optimize", "matplotlib.pyplot"),
    "restore": ("numba", "pandas", "matplotlib"),
    "produce": ("torchvision.transforms.v2", "matplotlib"),
    "train_classifier": ("kornia", "numba", "scipy.fft", "pandas", "matplotlib", "torchvision.transforms.v2"),
    "classify": ("numba", "pandas", "matplotlib", "torchvision.transforms.v2"),
}


CHAINS = [  # each job leaves out at least what the next ones do, so that one process imports them in turn
    ["images", "train_classifier", "classify", "capture", "produce"],
    ["restore", "design_lens"],
    ["psf_tail", "certify", "drawing"],
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


# ---- digests of code


FUNCTIONS = {name: workflow().get_rule(name).params.function for name in rule_names()}


def test_what_a_job_takes_of_the_settings_is_classes():
    """Digests omit this package: a job gets the values from its rule, and uses no constant of the settings."""
    modules = (digest.reached_modules(function.rpartition(".")[0]) for function in FUNCTIONS.values())
    for module in set().union(*modules):
        for node in ast.walk(digest.parse(module)):
            if (
                isinstance(node, ast.ImportFrom)
                and (node.module or "").count(".") > 1
                and digest.is_settings(node.module)
            ):
                constants = [alias.name for alias in node.names if alias.name.isupper() or alias.name.islower()]
                assert node.module == "tasklens.settings.names" or not constants, f"{module}: {ast.unparse(node)}"


def test_digests_cover_all_but_the_settings():
    """A digest covers all that the module of a job imports, lazily or not."""
    for function in FUNCTIONS.values():
        first = function.rpartition(".")[0]
        waiting, reached = [first], set()
        while waiting:
            module = waiting.pop()
            if module not in reached and not digest.is_settings(module):
                reached.add(module)
                path = ROOT.joinpath(*module.split("."))
                path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
                waiting += modules_named_in(path.read_text())
        assert digest.reached_modules(first) == reached


def modules_named_in(code: str) -> list[str]:
    """Our modules in the import statements of some code, found with a regular expression."""
    statement = r"^ *from ((?:tasklens|restoration)[\w.]*) import (?:\(([^)]*)\)|([^#(\n]*))"
    names = []
    for module, many, one in re.findall(statement, code, re.MULTILINE):
        names += [module, *(f"{module}.{word.split()[0]}" for word in (many or one).split(",") if word.strip())]
    modules = {name_of(path) for path in MODULES}
    return [name for name in names if name in modules]


TASKS = {"task_reference", "task_fine_tune"}
READ_IMAGES = {
    "images",
    "reference",
    "design",
    "restore",
    "fine_tune",
    "reproduce",
    "production",
    "captures",
    "frames",
    "scenes",
    *TASKS,
}
JUDGE = {"verdicts_table", "ablation", "report_page"}
RESAMPLED = JUDGE | {"ranking_table", "tolerances_table"}
TABLES = {f"{name}_table" for name in ("psf_tail", "effort", "merit_function", "ranking", "tolerances", "tasks")}
TABLES |= {"table", "certificate", "production"}
FIGURES = {"certificate", "comparison", "drawing", "frames", "ranking_table", "tasks_table"}
MEASUREMENTS = {"table", "verify", "comparison", "frames", "merit_function_table", "tolerances_table", *JUDGE}
PSFS = {"design", "psfs"}
OPTICS = {*PSFS, "psf_tail_table", "production", *FIGURES}
SEE = {"restore", "fine_tune", "reproduce", "captures"}
RENDER = {"design", "frames", "production", "merit_function_table", *SEE, *TASKS}


MODULES_OF = {
    "tasklens.optics.psf": OPTICS,
    "tasklens.camera.imaging": RENDER,
    "tasklens.recognition.scenes": READ_IMAGES,
    "tasklens.design.constraints": {"design"},
    "tasklens.study.report.measurements": MEASUREMENTS,
    "tasklens.show.publish": TABLES | JUDGE | {"sweep_table"},
    "restoration.nafnet": SEE,
    "tasklens.study.jobs.design_lens": {"design"},
    "tasklens.optics.analysis.diffraction": OPTICS,
    "tasklens.study.jobs.classify": SEE - {"restore", "captures"},
    "tasklens.optics.analysis.tail": {"psf_tail_table", *FIGURES},
    "tasklens.show.figures": FIGURES,
    "tasklens.study.report.page.words": {"report_page"},
    "tasklens.show.bootstrap": RESAMPLED,
}


@pytest.mark.parametrize("module, rules", MODULES_OF.items(), ids=MODULES_OF)
def test_only_these_jobs_run_a_module(module, rules):
    """A job whose code reaches a module without need runs again after its changes."""
    reached = {rule: digest.reached_modules(function.rpartition(".")[0]) for rule, function in FUNCTIONS.items()}
    assert {rule for rule in FUNCTIONS if module in reached[rule]} == rules


EDITS = [  # file, old, new, rules whose digests change
    ("tasklens/study/report/tables.py", "ddof=1", "ddof=0", {"table"}),
    ("restoration/nafnet_training.py", "_WARMUP = 0.05", "_WARMUP = 0.1", {"restore"}),
    ("tasklens/show/page.css", "{", "{color: red;", {"report_page", "ranking_table"}),
    ("tasklens/settings/specification.py", "Field(68.8,", "Field(68.9,", set()),  # it is in the settings of a job
    ("tasklens/settings/names.py", '"-restored"', '"-mended"', set()),  # it is in the settings, too
    ("tasklens/optics/psf.py", '"""Point spread', '"""Another docstring: point spread', set()),
    ("tasklens/optics/psf.py", "# The indices of far rays", "# Where the rays are far, indices", set()),
    ("tasklens/optics/psf.py", "import torch\n", "\n\nimport torch\n", set()),
    ("tasklens/study/jobs/design_lens.py", '"""Write the prescription', '"""Write a prescription', set()),
]


def test_code_changes_the_digests_of_the_jobs_that_run_it(tmp_path, monkeypatch):
    """Comments, docstrings, blank lines and settings rerun nothing."""

    def digests() -> dict[str, str]:
        for cached in (digest.parse, digest.code_and_imports, digest.code_digest):
            cached.cache_clear()
        return {name: digest.code_digest(function) for name, function in FUNCTIONS.items()}

    before = digests()
    for package in digest.PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    for path, old, new, _ in EDITS:
        text = (tmp_path / path).read_text()
        assert old in text
        (tmp_path / path).write_text(text.replace(old, new, 1))
    with monkeypatch.context() as patch:
        patch.setattr(digest, "ROOT", tmp_path)
        after = digests()
    assert {rule for rule in FUNCTIONS if after[rule] != before[rule]} == set().union(*(rules for *_, rules in EDITS))
    assert digests() == before  # the caches are those of our code again


def test_an_unknown_module_raises():
    with pytest.raises(ValueError, match="bake"):
        digest.code_digest("tasklens.study.jobs.bake.run")


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
    text = path.read_text()
    common = "".join(file.read_text() for file in (ROOT / "Snakefile", ROOT / "workflow/rules/common.smk"))
    for package, names in IMPORT.findall(common + text):
        for name, _, alias in (part.strip().partition(" as ") for part in names.split(",")):
            module = sys.modules.get(f"{package}.{name}")
            if module and package.startswith("tasklens"):
                used = re.findall(rf"(?<![\w./]){alias or name}\.(\w+)", text)
                assert [member for member in used if not hasattr(module, member)] == []
