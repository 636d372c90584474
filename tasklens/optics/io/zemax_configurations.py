"""Configurations of a Zemax file: differences from the configuration in which the file was saved."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from tasklens.materials.zemax_text import Line
from tasklens.optics.io.zemax_keywords import SOLVES, check_configuration, keywords
from tasklens.optics.io.zemax_surfaces import Block
from tasklens.runtime.files import FileError

# Operands that change rays or their use (OpticStudio user's guide, "Multi-Configuration Operands"); others belong to
# merit functions, or change neither.
_OPERANDS = keywords(
    "AFOC APDF APDT APDX APDY APER APMN APMX APTP CADX CADY CAOR CATX CATY CATZ CBDX CBDY CBOR CBTX CBTY CBTZ CONN "
    "CROR CRSR CRVT EDVA FLTP GLSS IGNM IGNR MABB MDPG MIND PAR1 PAR2 PAR3 PAR4 PAR5 PAR6 PAR7 PAR8 PRAM PRES PRWV "
    "SATP SDIA STPS TELE TEMP THIC WAVE XFIE YFIE"
)
_WORDS = {"THIC": "DISZ", "CRVT": "CURV", "CONN": "CONI", "GLSS": "GLAS"}  # operand, and the line of its surface
_ROUNDING = 1e-9  # relative rounding of values that are in a file twice


def in_configuration(blocks: list[Block], system: Mapping[str, Line], rows: Sequence[Line], number: int | None) -> int:
    """Change the surfaces in place to a configuration.

    Args:
        blocks: lines of all surfaces.
        system: lines of the system; MNUM has the number of configurations and the one in which the file was saved.
        rows: lines after the surfaces: OPERAND surface configuration value ...
        number: the configuration, from 1; None for the one in which the file was saved.

    Returns:
        The number of the configuration.

    Raises:
        FileError: no such configuration, or it differs in unsupported data.
    """
    line = system.get("MNUM")
    count = line.integer(0) if line is not None else 1
    saved = line.integer(1) if line is not None and len(line.words) > 1 else 1
    current = saved if number is None else number
    if not 1 <= current <= count:
        where = line.where if line is not None else blocks[0].head.where.rpartition(", line")[0]
        raise FileError(f"{where}: expected a configuration 1 .. {count}, got {current} (--configuration)")
    operands = {configuration: _operands(rows, configuration) for configuration in {saved, current}}
    for row in rows:
        if len(row.words) < 3 or row.words[1] == str(current):
            check_configuration(row)
    differ = any(row.words[2] != operands[saved].get(key, row).words[2] for key, row in operands[current].items())
    if differ:
        _check_solves(blocks, saved)
    for key, row in operands[current].items():
        block = blocks[key[1]] if key[1] < len(blocks) else None
        if block is None or key[0] not in _WORDS:
            if row.words[2:3] != operands[saved].get(key, row).words[2:3]:
                raise row.error(
                    f"differs from configuration {saved}, in which the file was saved; this is not supported"
                )
        elif current != saved:
            _set(block, row)
        else:
            _check(block, row)
    return current


def _operands(rows: Sequence[Line], configuration: int) -> dict[tuple[str, int, int], Line]:
    """Return the rows of a configuration by operand, surface, and number of earlier rows with both (`PRAM`, fields)."""
    before: Counter[tuple[str, int]] = Counter()
    operands = {}
    for row in rows:
        if row.keyword in _OPERANDS and len(row.words) > 2 and row.words[1] == str(configuration):
            key = row.keyword, row.integer(0)
            operands[*key, before[key]] = row
            before[key] += 1
    return operands


def _check_solves(blocks: Sequence[Block], saved: int) -> None:
    """Check that no value of a surface is solved: the file has only the solutions of the saved configuration."""
    solved = [line for block in blocks for keyword, line in block.lines.items() if keyword in SOLVES]
    curvatures = [block.lines["CURV"] for block in blocks if "CURV" in block.lines]
    solved += [line for line in curvatures if len(line.words) > 1 and line.integer(1) > 1]  # 1 is a variable
    if solved:
        raise solved[0].error(
            f"a solve, whose value is that of configuration {saved}; save the file in the other configuration in Zemax"
        )


def _set(block: Block, row: Line) -> None:
    keyword = _WORDS[row.keyword]
    suffix = " 0 0" if keyword == "GLAS" else ""
    block.lines[keyword] = replace(row, keyword=keyword, text=f"{row.words[2]}{suffix}")


def _check(block: Block, row: Line) -> None:
    """Check that a surface has the value that its configuration has."""
    keyword = _WORDS[row.keyword]
    line = block.lines.get(keyword)
    if keyword == "GLAS" or line is None or line.words[:1] == ["INFINITY"]:
        return
    if not math.isclose(line.number(0), row.number(2), rel_tol=_ROUNDING, abs_tol=_ROUNDING):
        raise row.error(
            f"the file was saved in this configuration, but its surface has {line.text.split()[0]}; save it again"
        )
