"""Read YAML files written by users; invalid YAML, and values that YAML would misread, are errors; no torch here."""

import re
from pathlib import Path
from typing import Any

import yaml

from tasklens.runtime.files import FileError, read_bytes

_LARGEST = 10_000_000  # bytes; our own files have a few thousand
_NODES = 1_000_000  # with aliases expanded: a few lines of aliases can stand for more nodes than fit into memory
_INTEGER = "tag:yaml.org,2002:int"
_LONGEST_INTEGER = 1000  # characters; Python neither reads nor prints decimals of more than 4300 digits
_OTHER_BASE = re.compile(r"[-+]?(0[0-7_]+|[0-9_]+(:[0-5]?[0-9])+)")  # 05 is octal, 1:30 sexagesimal


def read(path: Path) -> Any:
    """Read a YAML file.

    Raises:
        FileError: no regular file, no UTF-8, no valid YAML, too large, duplicate keys, or numbers in other bases; the
            message gives line and column.
    """
    text = _text(path)
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check(node, path)
        return loader.construct_document(node)
    except yaml.YAMLError as error:
        where = _place(path, getattr(error, "problem_mark", None))
        raise FileError(f"{where}: not valid YAML: {_why(error)}") from None
    except RecursionError:
        raise FileError(f"{path}: keys are nested too deeply") from None
    except FileError:
        raise
    except ValueError as error:  # a number with thousands of digits, or an invalid date
        raise FileError(f"{path}: not valid YAML: {error}") from None


def _text(path: Path) -> str:
    content = read_bytes(path, _LARGEST)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n") + 1
        raise FileError(f"{path}, line {row}: not valid YAML: the text is not UTF-8; save it as UTF-8") from None


def _place(path: Path, mark: yaml.Mark | None) -> str:
    return f"{path}, line {mark.line + 1}, column {mark.column + 1}" if mark else str(path)


def _why(error: yaml.YAMLError) -> str:
    problem = getattr(error, "problem", None) or str(error).splitlines()[0]
    if problem.startswith("but "):
        problem = f"{getattr(error, 'context', '')}, {problem}"
    return "a tab; indent with spaces" if r"'\t'" in problem else problem


def _check(node: yaml.Node, path: Path) -> None:
    """Reject duplicate keys, numbers in other bases, and aliases that contain themselves or expand too far."""
    sizes: dict[int, int] = {}  # number of nodes below a node, by its id; 0 while they are counted

    def count(node: yaml.Node) -> int:
        if id(node) in sizes:
            if not sizes[id(node)]:
                raise FileError(f"{_place(path, node.start_mark)}: contains itself; write the value out")
            return sizes[id(node)]
        sizes[id(node)] = 0
        children: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            _check_keys(node, path)
            children = [child for pair in node.value for child in pair]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        elif node.tag == _INTEGER and len(node.value) > _LONGEST_INTEGER:
            raise FileError(f"{_place(path, node.start_mark)}: not valid YAML: a number of {len(node.value)} digits")
        elif isinstance(node, yaml.ScalarNode) and _is_plain_integer(node) and _OTHER_BASE.fullmatch(node.value):
            value = yaml.safe_load(node.value)
            raise FileError(
                f"{_place(path, node.start_mark)}: YAML reads {node.value} as {value}; write {value}, or another number"
            )
        sizes[id(node)] = 1 + sum(map(count, children))
        if sizes[id(node)] > _NODES:
            raise FileError(f"{_place(path, node.start_mark)}: expands to more than {_NODES} values; write fewer")
        return sizes[id(node)]

    count(node)


def _is_plain_integer(node: yaml.ScalarNode) -> bool:
    return node.tag == _INTEGER and not node.style


def _check_keys(node: yaml.MappingNode, path: Path) -> None:
    seen: set[str] = set()
    for key, _ in node.value:
        if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
            if key.value in seen:
                raise FileError(f"{_place(path, key.start_mark)}: {key.value} appears twice; remove one")
            seen.add(key.value)
