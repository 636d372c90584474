"""Configurations of a Zemax file: operands that set values of surfaces and of the system."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from tasklens.materials.zemax_text import BLANK, Line
from tasklens.optics.io.zemax_keywords import SOLVES, check_configuration, check_system, keywords
from tasklens.optics.io.zemax_surfaces import Block, limits_rays
from tasklens.optics.io.zemax_system import INFINITY, system_aperture
from tasklens.runtime.files import FileError

# Operands (OpticStudio user's guide, "Multi-Configuration Operands") that change rays or their use, with the line and
# the word that they set. Others belong to merit functions, or change neither.
_SURFACE = {
    "THIC": (("DISZ", 0),),
    "CRVT": (("CURV", 0),),
    "CONN": (("CONI", 0),),
    "MIND": (("GLAS", 3),),
    "MABB": (("GLAS", 4),),
    "MDPG": (("GLAS", 5),),
    "SDIA": (("DIAM", 0), ("FLAP", 1)),
    "APMN": (("CLAP", 0),),
    "APMX": (("CLAP", 1),),
    "APDX": (("OBDC", 0),),
    "APDY": (("OBDC", 1),),
}
_PARAMETERS = {"PRAM": "PARM", "EDVA": "XDAT"}  # the number of the parameter is the fifth word
_OLD_PARAMETERS = {f"PAR{i}": i for i in range(1, 9)}
_SYSTEM = {"APDT": ("GFAC", 0), "APDF": ("GFAC", 1), "FLTP": ("FTYP", 0), "PRWV": ("PWAV", 0)}
_NUMBERED = {  # of a field or wavelength: the word of its own line, and the lines that list all
    "XFIE": ("FEFD", 1, ("XFLN", "XFLD")),
    "YFIE": ("FEFD", 2, ("YFLN", "YFLD")),
    "FVDX": ("FEFD", 4, ("VDXN",)),
    "FVDY": ("FEFD", 5, ("VDYN",)),
    "FVCX": ("FEFD", 6, ("VCXN",)),
    "FVCY": ("FEFD", 7, ("VCYN",)),
    "WAVE": ("WAVM", 1, ("WAVL", "WAVN")),
    "WLWT": ("WAVM", 2, ("WWGN", "WWGT")),
}
_SYSTEM_APERTURES = (("ENPD", 0), ("FNUM", 0), ("OBNA", 0), ("FLOA", 0), ("FNUM", 1), ("OBNA", 1))  # of SATP
_SURFACE_APERTURES = ("", "CLAP", "OBSC", "SPID", "SQAP", "SQOB", "ELAP", "ELOB", "UDAD", "UDAO", "FLAP")  # of APTP

_BEFORE_OTHERS = keywords("SATP STPS GLSS")  # what other operands change depends on these
_FIRST_ORDER = keywords("THIC CRVT GLSS MIND MABB MDPG PRAM EDVA STPS WAVE PRWV") | _OLD_PARAMETERS.keys()
_IGNORED = keywords("FVDX FVDY FVCX FVCY WLWT")  # vignetting factors and weights
_SOLVES = keywords("CSP1 CSP2 TSP1 TSP2 TSP3 PSP1 PSP2 PSP3")  # parameters of solves
_ROUNDING = 1e-9  # relative rounding of values that are in a file twice


def in_configuration(
    blocks: list[Block], system: dict[str, Line], rows: Sequence[Line], number: int | None
) -> tuple[int, list[str]]:
    """Change the lines of surfaces and system in place to a configuration.

    Args:
        blocks: lines of all surfaces.
        system: lines of the system; MNUM has the number of configurations and the one in which the file was saved.
        rows: lines after the surfaces: OPERAND number configuration value ...
        number: the configuration, from 1; None for the one in which the file was saved.

    Returns:
        The number of the configuration, and a remark if the file was saved in it with other values.

    Raises:
        FileError: no such configuration, or its operands set unsupported data.
    """
    line = system.get("MNUM")
    count = line.integer(0) if line is not None else 1
    saved = line.integer(1) if line is not None and len(line.words) > 1 else 1
    current = saved if number is None else number
    if not 1 <= current <= count:
        where = line.where if line is not None else blocks[0].head.where.rpartition(", line")[0]
        raise FileError(f"{where}: expected a configuration 1 .. {count}, got {current} (--configuration)")
    for row in rows:
        if len(row.words) < 3 or row.words[1] == str(current):
            check_configuration(row)
    operands = _operands(rows, current)
    changed = dict.fromkeys(row.keyword for row in operands if _apply(row, blocks, system))
    if {"APDT", "APDF"} & changed.keys():
        check_system(system["GFAC"])
    # A file that was saved in this configuration was solved for its apertures and fields, whatever they were.
    solved_otherwise = changed.keys() - _IGNORED or _differ(rows, saved, current)
    if _FIRST_ORDER & changed.keys() or (current != saved and solved_otherwise):
        _check_solves(blocks, current)
    if not changed or current != saved:
        return current, []
    return current, [f"the configuration replaces other values of surfaces or system: {', '.join(changed)}"]


def _operands(rows: Sequence[Line], configuration: int) -> list[Line]:
    own = [row for row in rows if len(row.words) > 2 and row.words[1] == str(configuration)]
    return sorted(own, key=lambda row: row.keyword not in _BEFORE_OTHERS)


def _differ(rows: Sequence[Line], *configurations: int) -> bool:
    """Return whether parameters of solves differ."""
    a, b = (
        sorted((row.keyword, row.words[0], row.words[2]) for row in _operands(rows, i) if row.keyword in _SOLVES)
        for i in configurations
    )
    return a != b


def _apply(row: Line, blocks: list[Block], system: dict[str, Line]) -> bool:
    """Set the value of an operand; return whether it was another one."""
    if row.keyword == "SATP":
        return _set_aperture_type(row, system)
    if row.keyword == "STPS":
        return _set_stop(row, blocks)
    if row.keyword in ("GLSS", "APTP"):
        number = row.integer(0)
        if not 0 <= number < len(blocks):
            return False
        return (_set_glass if row.keyword == "GLSS" else _check_aperture_type)(row, blocks[number].lines)
    return any([_set(lines, key, index, row) for lines, key, index in _places(row, blocks, system)])


def _places(row: Line, blocks: list[Block], system: dict[str, Line]) -> list[tuple[dict[Any, Line], Any, int]]:
    """Return where the value of an operand is: lines by key, the key of its line, and the index of its word.

    There is none for operands of a surface, field or wavelength that the file lacks, and for the thickness of the
    image, which Zemax ignores.
    """
    keyword = row.keyword
    if keyword in _SYSTEM:
        return [(system, *_SYSTEM[keyword])]
    if keyword == "APER":
        line = system_aperture(system)
        return [] if line is None or line.keyword == "FLOA" else [(system, line.keyword, 0)]
    if keyword in _NUMBERED:
        number, (own, index, lists) = row.integer(0), _NUMBERED[keyword]
        places = [(f"{own} {number}", index), *((name, number - 1) for name in lists)]
        return [(system, key, i) for key, i in places if key in system and 0 <= i < len(system[key].words)]
    if keyword not in {*_SURFACE, *_PARAMETERS, *_OLD_PARAMETERS} or not 0 <= row.integer(0) < len(blocks):
        return []
    block = blocks[row.integer(0)]
    if keyword in _PARAMETERS:
        return [(block.numbered, (_PARAMETERS[keyword], row.integer(4)), 1)]
    if keyword in _OLD_PARAMETERS:
        return [(block.numbered, ("PARM", _OLD_PARAMETERS[keyword]), 1)]
    unused = keyword == "THIC" and block is blocks[-1]
    return [(block.lines, *place) for place in _SURFACE[keyword] if not unused and _matters(place[0], block.lines)]


def _matters(keyword: str, lines: Mapping[str, Line]) -> bool:
    """Return whether rays depend on a line of a surface."""
    if keyword in ("CLAP", "FLAP"):
        return keyword in lines
    if keyword == "OBDC":
        return any(name in lines for name in _SURFACE_APERTURES)
    if keyword == "DIAM":
        return "STOP" in lines or limits_rays(lines)
    return keyword != "GLAS" or _is_model(lines)


def _is_model(lines: Mapping[str, Line]) -> bool:
    words = lines["GLAS"].words if "GLAS" in lines else []
    return words[:1] == [BLANK] or words[1:2] == ["1"]


def _set(lines: dict[Any, Line], key: Any, index: int, row: Line) -> bool:
    """Replace a word by the value of an operand; return whether it was another one."""
    line = lines.get(key, replace(row, keyword=key if isinstance(key, str) else key[0], text=""))
    words = [*line.words, *["0"] * (index + 1 - len(line.words))]
    if _same(words[index], row.words[2]):
        return False
    words[index] = row.words[2]
    lines[key] = replace(line, where=row.where, text=" ".join(words))
    return True


def _same(a: str, b: str) -> bool:
    try:
        x, y = (min(float(word), INFINITY) for word in (a, b))
    except ValueError:
        return False
    return abs(x - y) <= _ROUNDING * max(abs(x), abs(y))


def _set_glass(row: Line, lines: dict[str, Line]) -> bool:
    """Set the glass; an operand for air has no name, so that its value is the next word, 0."""
    name = row.words[2].upper()
    present = lines["GLAS"].words[:1] if "GLAS" in lines else []
    if name == "0" and not _is_model(lines):
        return lines.pop("GLAS", None) is not None
    if name in ("0", *(word.upper() for word in present)):
        return False
    lines["GLAS"] = replace(row, keyword="GLAS", text=f"{row.words[2]} 0 0")
    return True


def _check_aperture_type(row: Line, lines: Mapping[str, Line]) -> bool:
    """Check that the aperture of a surface has the type of an operand, so that nothing changes."""
    present = [name for name in _SURFACE_APERTURES if name in lines] or [""]
    kind = row.integer(2)
    if not 0 <= kind < len(_SURFACE_APERTURES) or present != [_SURFACE_APERTURES[kind]]:
        raise row.error(
            f"type {kind} is not that of the surface's aperture, and types by configuration are not supported; save "
            "the file in this configuration in Zemax"
        )
    return False


def _set_stop(row: Line, blocks: list[Block]) -> bool:
    stop = row.integer(2)
    if not 0 < stop < len(blocks) - 1:
        raise row.error(f"expected a stop between object and image, 1 .. {len(blocks) - 2}, found {stop}")
    if "STOP" in blocks[stop].lines:
        return False
    for block in blocks:
        block.lines.pop("STOP", None)
    blocks[stop].lines["STOP"] = replace(row, keyword="STOP", text="")
    return True


def _set_aperture_type(row: Line, system: dict[str, Line]) -> bool:
    """Set the type of the system aperture, which keeps its value; return whether it was another one."""
    line, kind = system_aperture(system), row.integer(2)
    if not 0 <= kind < len(_SYSTEM_APERTURES):
        raise row.error(f"expected a type 0 .. {len(_SYSTEM_APERTURES) - 1} of the system aperture, found {kind}")
    keyword, variant = _SYSTEM_APERTURES[kind]
    if line is None or (line.keyword == keyword and (line.words[1:2] or ["0"]) == [str(variant)]):
        return False
    del system[line.keyword]
    value = (line.words or ["0"])[0]
    system[keyword] = replace(row, keyword=keyword, text=f"{value} {variant}")
    return True


def _check_solves(blocks: Sequence[Block], current: int) -> None:
    """Check that no value of a surface is solved: the file has only the solutions for the lens as it was saved."""
    solved = [line for block in blocks for keyword, line in block.lines.items() if keyword in SOLVES]
    curvatures = [block.lines["CURV"] for block in blocks if "CURV" in block.lines]
    solved += [line for line in curvatures if len(line.words) > 1 and line.integer(1) > 1]  # 1 is a variable
    if solved:
        raise solved[0].error(
            f"a solve, whose value in the file need not be that of configuration {current}; save the file in this "
            "configuration in Zemax"
        )
