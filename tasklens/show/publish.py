"""Write tables: CSV with all digits, and Markdown for readers with a title and a note."""

from pathlib import Path

import pandas

from tasklens.runtime.files import write_text
from tasklens.show import headings


def markdown(table: pandas.DataFrame) -> str:
    """Format a table of texts in Markdown."""
    return table.to_markdown(index=False, disable_numparse=True)


def right_aligned(table: pandas.DataFrame) -> str:
    """Format a table of texts in Markdown with right-aligned columns."""
    return table.to_markdown(index=False, disable_numparse=True, stralign="right")


def publish(
    csv: Path, md: Path, title: str, table: pandas.DataFrame, note: str, shown: pandas.DataFrame | None = None
) -> None:
    """Write a table as CSV and as Markdown.

    Args:
        note: text below the Markdown table; a table without rows is left out.
        shown: the table of the Markdown, if it differs from that of the CSV.
    """
    write_text(csv, table.to_csv(index=False))
    shown = table if shown is None else shown
    body = f"{markdown(headings.texts(shown))}\n\n" if len(shown) else ""
    write_text(md, f"**{title}**\n\n{body}{note}\n")
