"""Digests of what a job depends on beside its files: the code of its stage, and a folder of photographs.

Snakemake reruns the jobs whose digest changed, and no others. That of the code covers the module of the stage's
function and every module of ours that it imports, directly or through others, as syntax trees without docstrings: an
edited comment or docstring changes nothing.

Modules that hold data alone are left out, since what a stage reads of them is in the settings of its jobs. Nothing that
is computed with may stand in them, nor be imported from them, but classes of settings and errors.
"""

import ast
import hashlib
import os
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("tasklens", "restoration")
DATA_ONLY = tuple(
    f"tasklens.study.{name}"
    for name in ("settings", "design_settings", "ablations", "feasibility", "study", "loading", "tables", "claims")
)


def module_path(module: str) -> Path | None:
    """File of one of our modules; None if there is none of this name."""
    path = ROOT.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def imports(tree: ast.AST) -> set[str]:
    """Our own modules that a syntax tree imports, wherever the import stands."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] in PACKAGES and module_path(name)}


@cache
def parse(module: str) -> ast.Module:
    """Syntax tree of one of our modules, without docstrings."""
    path = module_path(module)
    if path is None:
        raise ValueError(f"unknown module {module!r}")
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                del body[0]
    return tree


def reached_modules(module: str) -> set[str]:
    """A module and all that it reaches through imports, those of data alone excluded."""
    reached: set[str] = set()
    waiting = {module}
    while waiting:
        found = waiting.pop()
        if found not in reached and found not in DATA_ONLY:
            reached.add(found)
            waiting |= imports(parse(found))
    return reached


@cache
def code_digest(function: str) -> str:
    """Digest of the code that a function of a module, `package.module.function`, may run."""
    trees = (ast.dump(parse(module)) for module in sorted(reached_modules(function.rpartition(".")[0])))
    return hashlib.sha256("\n".join([function, *trees]).encode()).hexdigest()[:16]


def folder_digest(folder: Path) -> str:
    """Digest of the names, sizes and times of change of all files below a folder; of an absent one, too."""
    entries = []
    for root, folders, files in os.walk(folder, followlinks=True):
        folders.sort()
        for name in sorted(files):
            path = os.path.join(root, name)
            status = os.stat(path) if os.path.exists(path) else os.lstat(path)  # a link to nowhere
            entries.append(f"{os.path.relpath(path, folder)} {status.st_size} {status.st_mtime_ns}")
    return hashlib.sha256("\n".join(entries).encode()).hexdigest()[:16]
