"""LaTeX tables for a paper."""

import re

import pandas

from tasklens.show import headings


def tabular(table: pandas.DataFrame, caption: str, label: str) -> str:
    """Write a table with words and units as headings, means with their standard deviations, the best values bold.

    Args:
        caption: plain text.
        label: LaTeX label of the table; underscores become hyphens.
    """
    names, texts = headings.columns(table), headings.texts(table)
    bold = {text: headings.best(table, name) for text, name in zip(texts, names, strict=True)}
    style = texts.style.hide(axis="index").format(escape="latex").format_index(escape="latex", axis="columns")
    style = style.apply(lambda column: ["textbf:--rwrap;" if best else "" for best in bold[str(column.name)]])
    latex = style.to_latex(
        column_format="".join("r" if headings.is_number(table[name]) else "l" for name in names),
        hrules=True,
        position_float="centering",
        caption=re.sub(r"[&%$#_{}]", r"\\\g<0>", caption),
        label=label.replace("_", "-"),
    )
    return "% Needs \\usepackage{booktabs}.\n" + latex
