"""The digest of a job's code covers the modules that the job runs, and nothing else changes it."""

import ast
import re
import shutil

import pytest
from our_modules import MODULES, ROOT, name_of
from rules import rule_names, workflow

from tasklens.study.run import digest

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
SEE = {"restore", "fine_tune", "reproduce", "captures"}
READ_IMAGES = {"images", "reference", "design", "production", "frames", "scenes", *SEE, *TASKS}
JUDGE = {"verdicts_table", "ablation", "report_page"}
RESAMPLED = JUDGE | {"ranking_table", "tolerances_table"}
TABLES = {f"{name}_table" for name in ("psf_tail", "effort", "merit_function", "ranking", "tolerances", "tasks")}
TABLES |= {"table", "certificate", "production"}
FIGURES = {"certificate", "comparison", "drawing", "frames", "ranking_table", "tasks_table"}
MEASUREMENTS = {"table", "verify", "comparison", "frames", "merit_function_table", "tolerances_table", *JUDGE}
PSFS = {"design", "psfs"}
OPTICS = {*PSFS, "psf_tail_table", "production", *FIGURES}
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
