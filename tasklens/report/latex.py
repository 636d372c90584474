"""LaTeX tables for a paper."""

import re

import pandas

from tasklens.report import headings
from tasklens.report.headings import PAPER

_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "±": r"$\pm$",
}
_TEMPLATE = r"""% Needs \usepackage{{booktabs}}.
\begin{{table}}
\centering\footnotesize\setlength{{\tabcolsep}}{{3pt}}
\caption{{{caption}}}
\label{{{label}}}
\begin{{tabular}}{{{alignment}}}
\toprule
{header} \\
\midrule
{rows}
\bottomrule
\end{{tabular}}
\end{{table}}
"""


def tabular(table: pandas.DataFrame, caption: str, label: str) -> str:
    """Write a table: words and units as headings, means with their standard deviations, the best values bold.

    Args:
        caption: plain text.
        label: LaTeX label of the table; characters that are special in LaTeX become hyphens.
    """
    names = headings.columns(table)
    numeric = {name: pandas.api.types.is_numeric_dtype(table[name]) for name in names}
    best = {name: headings.best(table, name) for name in names}
    rows = []
    for k, row in enumerate(table.to_dict("records")):
        cells = (
            _number(name, row, best[name][k]) if numeric[name] else escaped(headings.cell(name, row, False))
            for name in names
        )
        rows.append(f"{' & '.join(cells)} \\\\")
    return _TEMPLATE.format(
        caption=escaped(caption),
        label=re.sub(r"[^\w:.-]|_", "-", label),
        alignment="".join("r" if numeric[name] else "l" for name in names),
        header=" & ".join(_heading(name, numeric[name]) for name in names),
        rows="\n".join(rows),
    )


def escaped(text: str) -> str:
    """Return plain text as LaTeX."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def _heading(name: str, numeric: bool) -> str:
    """Stack the words of a heading, so that columns are narrow; LaTeX would take `[` without braces for an option."""
    heading = headings.heading(name)
    lines = [escaped(word) for word in heading.words.split()]
    lines += ["(paper)"] if name.endswith(PAPER) else []
    if heading.unit:
        lines.append("{}[" + escaped(heading.unit).replace("um", r"$\mu$m") + "]")
    return rf"\shortstack[{'r' if numeric else 'l'}]{{" + r"\\".join(lines) + "}" if len(lines) > 1 else lines[0]


def _number(name: str, row: dict, best: bool) -> str:
    if pandas.isna(row[name]):
        return "--"
    value, spread = (re.sub(r"[+-]", r"$\g<0>$", text) for text in headings.number(name, row))
    value = rf"\textbf{{{value}}}" if best else value
    return rf"{value} $\pm$ {spread}" if spread else value
