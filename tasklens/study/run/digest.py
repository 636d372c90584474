"""Digest of the code of a job: Snakemake reruns the jobs whose digest changed.

It covers the module of the job's function and all our modules that it imports, directly or indirectly, as syntax trees
without docstrings, so that editing comments or docstrings does not change it, and the templates and tables beside them.
It leaves out settings, the modules of `tasklens.settings` and `tasklens.study` (not those of its folders): a job's
settings contain everything that the job reads of a study, also the coefficients of its plastics.
"""

import ast
import hashlib
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[3]
SNAKEFILE = ROOT / "Snakefile"
NOT_INSTALLED = "the workflow is not installed: clone the repository, and install it by `pip install -e .`"
PACKAGES = ("tasklens", "restoration")
_TEMPLATES = (".html", ".css", ".js", ".csv")
_LENGTH = 16  # of a digest [hexadecimal digits]


def module_path(module: str) -> Path | None:
    """Return the file of one of our modules; None if it does not exist."""
    path = ROOT.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def imports(tree: ast.AST) -> set[str]:
    """Return our modules that a syntax tree imports, at any depth."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] in PACKAGES and module_path(name)}


@cache
def parse(module: str) -> ast.Module:
    """Parse one of our modules to a syntax tree without docstrings; raises ValueError for an unknown one."""
    path = module_path(module)
    if path is None:
        raise ValueError(f"unknown module {module!r}")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                del body[0]
    return tree


@cache
def code_and_imports(module: str) -> tuple[str, set[str]]:
    """Return the code of one of our modules without docstrings and comments, and our modules that it imports.

    The code includes the templates and tables beside the module that it names.
    """
    tree, path = parse(module), module_path(module)
    assert path is not None
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    named = sorted(text for text in texts if text.endswith(_TEMPLATES) and (path.parent / text).is_file())
    templates = [(path.parent / name).read_text(encoding="utf-8") for name in named]
    return "\n".join([repr(_shape(tree)), *templates]), imports(tree)


def _shape(node: object) -> object:
    """Return a syntax tree as nested lists without empty fields, which differ between versions of Python."""
    if isinstance(node, ast.AST):
        fields = [[name, _shape(value)] for name, value in ast.iter_fields(node) if value not in (None, [])]
        return [type(node).__name__, *fields]
    return [_shape(item) for item in node] if isinstance(node, list) else repr(node)


def is_digest(text: str) -> bool:
    """Return whether a text looks like a digest."""
    return re.fullmatch(f"[0-9a-f]{{{_LENGTH}}}", text) is not None


def is_settings(module: str) -> bool:
    """Return whether a module declares settings: it is in the folder of the settings, or in that of the study."""
    path = module_path(module)
    return path is not None and path.parent in (ROOT / "tasklens" / "settings", ROOT / "tasklens" / "study")


def reached_modules(module: str) -> set[str]:
    """Return a module and all modules it imports, directly or indirectly, except settings."""
    modules: set[str] = set()
    waiting = {module}
    while waiting:
        current = waiting.pop()
        if current not in modules and not is_settings(current):
            modules.add(current)
            waiting |= code_and_imports(current)[1]
    return modules


@cache
def code_digest(function: str) -> str:
    """Compute the digest of the code that the function `package.module.function` may run."""
    trees = (code_and_imports(module)[0] for module in sorted(reached_modules(function.rpartition(".")[0])))
    return hashlib.sha256("\n".join([function, *trees]).encode()).hexdigest()[:_LENGTH]
