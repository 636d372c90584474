"""Search of a text for YAML that nobody means: keys that stand twice, and numbers of other bases."""

import re

import yaml

_OTHER_BASE = re.compile(r"[-+]?(0[0-7_]+|[0-9_]+(:[0-5]?[0-9])+)")  # 05 is octal, 1:30 sexagesimal


def problem(text: str) -> str | None:
    """Say where a text has a key twice in a mapping, or a number of another base; None without such.

    Raises:
        yaml.YAMLError: the text is no YAML.
    """
    waiting, seen = [yaml.compose(text, yaml.SafeLoader)], set()
    while waiting:
        node = waiting.pop()
        if node is None or id(node) in seen:  # an alias
            continue
        seen.add(id(node))
        if isinstance(node, yaml.MappingNode):
            keys: set[str] = set()
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                    if key.value in keys:
                        return f"{_place(key)}: {key.value} stands twice; remove one"
                    keys.add(key.value)
                waiting.append(value)
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
        elif isinstance(node, yaml.ScalarNode) and _is_of_another_base(node):
            found = yaml.safe_load(node.value)
            return f"{_place(node)}: YAML reads {node.value} as {found}; write {found}, or another number"
    return None


def _is_of_another_base(node: yaml.ScalarNode) -> bool:
    return node.tag == "tag:yaml.org,2002:int" and not node.style and bool(_OTHER_BASE.fullmatch(node.value))


def _place(node: yaml.Node) -> str:
    return f"line {node.start_mark.line + 1}, column {node.start_mark.column + 1}"
