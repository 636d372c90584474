"""Write tables: CSV with all digits, and rounded Markdown with a title and a note."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pandas

from tasklens.runtime.files import write_text

GAP = "–"


def rounded(table: pandas.DataFrame, digits: Mapping[str, str]) -> pandas.DataFrame:
    """Format a table as text: columns by the longest matching prefix in `digits`, missing values as dashes.

    Args:
        digits: format such as "+.2f" by prefix of column names; "" for all other numbers.
    """
    texts = table.astype(object)
    for column in table.columns:
        prefixes = [begin for begin in digits if str(column).startswith(begin)]
        if prefixes and pandas.api.types.is_numeric_dtype(table[column]) and table[column].dtype != bool:
            texts[column] = table[column].map(_formatter(digits[max(prefixes, key=len)]))
    return texts.where(table.notna(), GAP).replace("", GAP)


def _formatter(form: str) -> Callable[[float], str]:
    return lambda value: GAP if pandas.isna(value) else format(value, form)


def right_aligned(table: pandas.DataFrame) -> str:
    """Format a table of texts in Markdown with right-aligned columns."""
    return table.to_markdown(index=False, disable_numparse=True, stralign="right")


def publish(csv: Path, md: Path, title: str, table: pandas.DataFrame, texts: pandas.DataFrame, note: str) -> None:
    """Write a table as CSV and as Markdown.

    Args:
        texts: the table as text, from `rounded`.
        note: text below the Markdown table; a table without rows is left out.
    """
    write_text(csv, table.to_csv(index=False))
    body = f"{texts.to_markdown(index=False, disable_numparse=True)}\n\n" if len(table) else ""
    write_text(md, f"**{title}**\n\n{body}{note}\n")
