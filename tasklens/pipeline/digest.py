"""Digests of what a job depends on beside its files: the code of its stage, and a folder of photographs.

Snakemake reruns the jobs whose digest changed, and no others. That of the code covers the stage's function in
`pipeline.stages`, the helpers there that it calls, and every module of ours that they import, directly or through
others, as syntax trees without docstrings: an edited comment or docstring changes nothing.

Modules that hold data alone are left out, since what a stage reads of them is in the slice of its job. Nothing that is
computed with may stand in them, nor be imported from them, but classes of settings and errors.
"""

import ast
import hashlib
import os
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("tasklens", "restoration")
STAGES = ("tasklens.pipeline.stages.measure", "tasklens.pipeline.stages.report")
DATA_ONLY = (
    "tasklens.study.settings",
    "tasklens.study.design_settings",
    "tasklens.study.ablations",
    "tasklens.study.feasibility",
    "tasklens.study.study",
    "tasklens.study.tables",
    "tasklens.study.claims",
    "tasklens.pipeline.stage",
    "tasklens.pipeline.jobs",
)


def _file(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def imports(tree: ast.AST) -> set[str]:
    """Our own modules that a syntax tree imports, wherever the import stands."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] in PACKAGES and _file(name)}


@cache
def parse(module: str) -> ast.Module:
    """Syntax tree of one of our modules, without docstrings."""
    path = _file(module)
    assert path is not None, module
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                del body[0]
    return tree


def reached_modules(function: ast.AST) -> set[str]:
    """Our modules that a function reaches through imports, those of data alone excluded."""
    reached: set[str] = set()
    waiting = imports(function)
    while waiting:
        module = waiting.pop()
        if module not in reached and module not in DATA_ONLY:
            reached.add(module)
            waiting |= imports(parse(module))
    return reached


def _names(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def stage_code(function: str) -> list[ast.AST]:
    """Syntax trees behind a stage: its function, its helpers, and the modules that they reach.

    Raises:
        ValueError: no stage has a function of this name.
    """
    functions, helpers = {}, []
    for node in (node for module in STAGES for node in parse(module).body if isinstance(node, ast.FunctionDef)):
        if node.name.startswith("_"):
            helpers.append(node)
        else:
            functions[node.name] = node
    if function not in functions:
        raise ValueError(f"unknown stage {function!r}; expected one of {', '.join(functions)}")
    used = [node for node in helpers if node.name in _names(functions[function])]
    reached = reached_modules(ast.Module([functions[function], *used], []))
    return [functions[function], *used, *(parse(module) for module in sorted(reached))]


@cache
def code_digest(function: str) -> str:
    """Digest of the code behind the stage with this function."""
    return hashlib.sha256("\n".join(map(ast.dump, stage_code(function))).encode()).hexdigest()[:16]


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
