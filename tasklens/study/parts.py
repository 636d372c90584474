"""Interim reports of a study: table 1 of its first sets of elements, each with its own page."""

from tasklens.study.loading import parse, resolved
from tasklens.study.study import Study

_SEPARATOR = "/elements="


def parts(study: Study) -> list[Study]:
    """Return the parts of a study, named `{study}/elements={first}+...`, which use its lenses and networks.

    Each has one element count more than the one before it, and the last has one fewer than the study. A sweep, or a
    study without table 1, has none.
    """
    if study.sweep or "table1" not in study.tables:
        return []
    names = list(study.elements)
    return [_part(study, names[:count]) for count in range(1, len(names))]


def whole_study_name(name: str) -> str:
    """Return the name of the study whose lenses and networks a study uses: its own, unless it is a part."""
    return name.partition(_SEPARATOR)[0]


def _part(study: Study, names: list[str]) -> Study:
    content = resolved(study)
    content |= {
        "name": f"{study.name}{_SEPARATOR}{'+'.join(names)}",
        "tables": ["table1"],
        "elements": {name: content["elements"][name] for name in names},
        "specs": {name: spec for name, spec in content["specs"].items() if name in names},
        "imported": {name: lens for name, lens in content["imported"].items() if lens["elements"] in names},
        "ablations": {},
        "restored": None,
        "tasks": content["tasks"] | {"designs": None},
        "tolerances": content["tolerances"] | {"designs": None},
    }
    return parse(content)
