"""The digest of a job's code covers the modules that the job runs, and nothing else changes it."""

import ast
import re
import shutil

import pytest
from rules import MODULES, ROOT, name_of, rule_names, workflow

from tasklens.study.run import digest
from tasklens.study.run.changes import COUNTED

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


REPEATED = {  # by module: the expensive jobs that its changes repeat
    "tasklens.optics.tracing.kernel": {"design", "production"},
    "tasklens.design.constraints": {"design"},
    "restoration.nafnet": {"restore", "fine_tune"},
    "tasklens.show.publish": {"production"},
}


@pytest.mark.parametrize("module, rules", REPEATED.items(), ids=REPEATED)
def test_only_these_jobs_run_a_module(module, rules):
    """A job whose code reaches a module without need runs again after its changes."""
    assert {rule for rule in COUNTED if module in digest.reached_modules(FUNCTIONS[rule].rpartition(".")[0])} == rules


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
