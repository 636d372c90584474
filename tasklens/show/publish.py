"""Write tables: CSV with all digits, and Markdown for readers with a title and a note."""

from pathlib import Path

import pandas

from tasklens.runtime.files import write_text
from tasklens.show import headings

TITLES = {  # of tables, by the stem of their files
    "table1": "Table 1: accuracy, image quality and spot size of each lens",
    "table2": "Table 2: accuracy with other classifiers",
    "table3": "Table 3: task-driven against end-to-end design",
    "table4": "Table 4: after image restoration",
    "verdicts": "Verdicts on the paper's claims",
    "psf_tail": "Tails of the PSFs: core (50 % of the light about the chief ray) and light outside three core radii",
    "effort": "Effort of each design: lens evaluations, and wall time",
    "tolerances": "Built lenses: what each design loses in manufacture",
    "tolerances_compared": "What a task-driven lens loses in manufacture minus what an imaging lens loses [points]",
    "tasks": "Other tasks: scores of their networks through each lens",
    "merit_function": "Merit functions: weight of each spatial frequency [cycles per pixel] for each classifier",
    "sweep": "Sweep",
    "ranking": "Which lens for this network?",
}


def title(name: str) -> str:
    """Return the title of a table, by the stem of its file."""
    ablation = name.removeprefix("ablation_")
    return TITLES[name] if ablation == name else f"Ablation: {ablation.replace('_', ' ')}"


def markdown(table: pandas.DataFrame) -> str:
    """Format a table of texts in Markdown."""
    return table.to_markdown(index=False, disable_numparse=True)


def right_aligned(table: pandas.DataFrame) -> str:
    """Format a table of texts in Markdown with right-aligned columns."""
    return table.to_markdown(index=False, disable_numparse=True, stralign="right")


def publish(csv: Path, md: Path, table: pandas.DataFrame, note: str, shown: pandas.DataFrame | None = None) -> None:
    """Write a table as CSV and as Markdown.

    Args:
        note: text below the Markdown table; a table without rows is left out.
        shown: the table of the Markdown, if it differs from that of the CSV.
    """
    write_text(csv, table.to_csv(index=False))
    shown = table if shown is None else shown
    body = f"{markdown(headings.texts(shown))}\n\n" if len(shown) else ""
    write_text(md, f"**{title(csv.stem)}**\n\n{body}{note}\n")
