"""Digests of dependencies of a job that are no input files: the code of its stage, and a folder of photographs.

Snakemake reruns the jobs whose digest changed. The code digest covers the module of the stage's function and all our
modules that it imports, directly or indirectly, as syntax trees without docstrings, so that editing comments or
docstrings does not change it.

Modules of data only are left out, since their values are in the settings of the jobs: only classes of settings and
errors may be imported from them, and nothing computes with their constants, functions or methods.
"""

import ast
import hashlib
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("tasklens", "restoration")
DATA_ONLY = tuple(
    f"tasklens.study.{name}"
    for name in (
        "quantities",
        "renamed",
        "settings",
        "tolerance_settings",
        "task_settings",
        "learning_rates",
        "design_settings",
        "lens_entries",
        "ablations",
        "feasibility",
        "consistency",
        "study",
        "loading",
        "tables",
        "claims",
        "effort",
    )
)


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
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                del body[0]
    return tree


@cache
def code_and_imports(module: str) -> tuple[str, set[str]]:
    """Return the code of one of our modules without docstrings and comments, and our modules that it imports."""
    tree = parse(module)
    return ast.dump(tree), imports(tree)


def reached_modules(module: str) -> set[str]:
    """Return a module and all modules it imports, directly or indirectly, except those of data only."""
    reached: set[str] = set()
    waiting = {module}
    while waiting:
        found = waiting.pop()
        if found not in reached and found not in DATA_ONLY:
            reached.add(found)
            waiting |= code_and_imports(found)[1]
    return reached


@cache
def code_digest(function: str) -> str:
    """Compute the digest of the code that the function `package.module.function` may run."""
    trees = (code_and_imports(module)[0] for module in sorted(reached_modules(function.rpartition(".")[0])))
    return hashlib.sha256("\n".join([function, *trees]).encode()).hexdigest()[:16]


def folder_digest(folder: Path) -> str:
    """Compute the digest of names, sizes and modification times of all files below a folder, which may be absent."""
    entries, seen = [], set()
    for root, folders, files in os.walk(folder, followlinks=True):
        status = os.stat(root)
        if (status.st_dev, status.st_ino) in seen:  # a link to a folder around it: there is no end
            folders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        folders.sort()
        for name in sorted(files):
            path = os.path.join(root, name)
            status = os.stat(path) if os.path.exists(path) else os.lstat(path)  # a broken link
            entries.append(f"{os.path.relpath(path, folder)} {status.st_size} {status.st_mtime_ns}")
    return hashlib.sha256("\n".join(entries).encode()).hexdigest()[:16]


def digest_of(*parts: str, inputs: Sequence[Path] = ()) -> str:
    """Compute the digest of what a job computes: texts such as its settings and its code digest, and input files.

    Input files are identified by size and modification time, since images can be hundreds of gigabytes.
    """
    texts = list(parts)
    for path in inputs:
        status = path.stat()
        texts.append(f"{path} {status.st_size} {status.st_mtime_ns}")
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]
