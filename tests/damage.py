"""Damaged files for fuzzing: hypothesis strategies that change the content or the text of a good file."""

import copy
import math
from collections.abc import Iterator

import yaml
from hypothesis import strategies as st


class Plain(str):
    """Characters that stand in a YAML file without quotes."""


class Dumper(yaml.SafeDumper):
    pass


def represent_plain(dumper: Dumper, value: Plain) -> yaml.Node:
    return dumper.represent_scalar(dumper.resolve(yaml.ScalarNode, value, (True, False)), str(value))


Dumper.add_representer(Plain, represent_plain)
Dumper.add_representer(tuple, Dumper.represent_list)


def dump_yaml(content) -> str:
    return yaml.dump(content, Dumper=Dumper, sort_keys=False, allow_unicode=True)


PLAIN = [
    *("0x10", "0b101", "1_000", "1e3", "1e999", "-1e-999", "-.inf", "-0.0", "+1", "1.", "~", "=", "<<"),
    *("yes", "Off", "null", "2026-01-01T00:00:00Z"),
]
HOSTILE = ["0x" + "f" * 5000, ".nan", ".inf", "2026-01-01", "1" * 400]
NUMBERS = st.one_of(
    st.integers(-3, 70),
    st.integers(),
    st.sampled_from([2**31, 2**63 - 1, 2**63, -(2**63), 2**64, 10**18, 10**400, 1e308, 5e-324, math.inf, math.nan]),
    st.floats(),
    st.floats(0, 3),
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


def values(words: list[str], leaves: int = 5) -> st.SearchStrategy:
    """Any value that a YAML file can hold, often with words of the file itself."""
    scalars = st.one_of(
        NUMBERS,
        st.sampled_from(words),
        st.booleans() | st.none(),
        TEXTS | st.text("0123456789.eE+-_x ", max_size=8),
        st.sampled_from(PLAIN).map(Plain),
        st.sampled_from(HOSTILE).map(Plain),
        st.dates() | st.datetimes() | st.binary(max_size=6) | st.sets(TEXTS, max_size=2),
    )
    keys = st.sampled_from(words) | TEXTS | st.integers(0, 9) | st.booleans() | st.floats(allow_nan=False) | st.none()
    return st.recursive(
        scalars,
        lambda inner: (
            st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=3) | st.tuples(NUMBERS, NUMBERS)
        ),
        max_leaves=leaves,
    )


def places(content, above: tuple = ()) -> Iterator[tuple]:
    """Keys and indices of all values of nested mappings and lists."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in pairs:
        yield (*above, key)
        yield from places(value, (*above, key))


def words_of(content) -> list[str]:
    leaves = [place[-1] for place in places(content)]
    words = {word for word in leaves if isinstance(word, str)}
    return sorted(words | {word for word in scalars_of(content) if isinstance(word, str)})


def scalars_of(content) -> Iterator:
    if isinstance(content, dict | list):
        for inner in content.values() if isinstance(content, dict) else content:
            yield from scalars_of(inner)
    else:
        yield content


@st.composite
def changed_content(draw, content) -> object:
    """The content with one to three values replaced, added, removed, doubled, or moved to another key."""
    words = words_of(content)
    content = copy.deepcopy(content)
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        paths = list(places(content))
        if not paths:
            return content
        section = draw(st.sampled_from(list(content)))  # short sections as often as long ones
        *above, key = draw(st.sampled_from([place for place in paths if place[0] == section]))
        inside = content
        for step in above:
            inside = inside[step]
        action = draw(st.sampled_from(["near", "near", "value", "value", "value", "add", "remove", "copy", "rename"]))
        if action == "near":  # of the same kind, so that some are accepted
            inside[key] = draw(near(inside[key], words))
        elif action == "value":
            inside[key] = draw(values(words))
        elif action == "remove":
            del inside[key]
        elif action == "copy":
            node = content
            for step in draw(st.sampled_from(paths)):
                node = node[step]
            inside[key] = copy.deepcopy(node)
        elif isinstance(inside, list):
            inside.insert(key, draw(values(words)))
        elif action == "rename":
            inside[draw(st.sampled_from(words) | TEXTS)] = inside.pop(key)
        else:
            inside[draw(st.sampled_from(words) | TEXTS)] = draw(values(words))
    return content


def near(value, words: list[str]) -> st.SearchStrategy:
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, int):
        return st.integers(0, 2 * abs(value) + 2)
    if isinstance(value, float):
        return st.sampled_from([0.5, 0.9, 1.1, 2.0, -1.0]).map(lambda factor: factor * value)
    if isinstance(value, list) and value:
        return st.permutations(value) | st.just([*value, value[0]]) | st.just(value[1:])
    return st.sampled_from(words)


def altered_text(text: str, inserted: list[str]) -> st.SearchStrategy[str]:
    """The text with words replaced, and lines removed, repeated, exchanged or indented."""

    @st.composite
    def strategy(draw) -> str:
        lines = text.split("\n")
        for _ in range(draw(st.integers(1, 3))):
            row = draw(st.integers(0, len(lines) - 1))
            match draw(
                st.sampled_from(["word", "word", "word", "word", "insert", "remove", "repeat", "exchange", "indent"])
            ):
                case "word":
                    words = lines[row].split(" ")
                    new = st.sampled_from(inserted) | NUMBERS.map(str) | TEXTS
                    words[draw(st.integers(0, len(words) - 1))] = draw(new)
                    lines[row] = " ".join(words)
                case "insert":
                    line = st.lists(st.sampled_from(inserted) | NUMBERS.map(str), max_size=5).map(" ".join)
                    lines.insert(row, draw(st.sampled_from(["", "  "])) + draw(line))
                case "remove" if len(lines) > 1:
                    del lines[row]
                case "repeat":
                    lines.insert(row, draw(st.sampled_from(lines)))
                case "exchange":
                    other = draw(st.integers(0, len(lines) - 1))
                    lines[row], lines[other] = lines[other], lines[row]
                case "indent":
                    lines[row] = lines[row].strip() if lines[row].startswith(" ") else f"  {lines[row]}"
        return "\n".join(lines)

    return strategy()
