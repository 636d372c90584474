"""The answer of a study in a few sentences, from its table of verdicts."""

import csv
from pathlib import Path

_KINDS = {
    "more": "more accurate than",
    "less": "less accurate than",
    "undecided": "as accurate, as far as can be told, as",
}


def sentences(verdicts: Path) -> list[str]:
    """Return a sentence for each task-driven lens, about the claims of the first table that has any.

    Only claims that compare lenses with others by the first classifier of the table; `verdicts` has the others too.
    """
    with open(verdicts, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if " accurate " in row["claim"] and row["difference"]]
    rows = [row for row in rows if row["table"] == rows[0]["table"] and row["classifier"] == rows[0]["classifier"]]
    by_lens: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        by_lens.setdefault(row["lens"], []).append(row)
    return [_sentence(lens, found) for lens, found in by_lens.items()]


def _sentence(lens: str, rows: list[dict[str, str]]) -> str:
    kinds: dict[str, list[str]] = {kind: [] for kind in _KINDS}
    for row in rows:
        difference = float(row["difference"])
        kind = "undecided" if row["verdict"] == "undecided" else "more" if difference > 0 else "less"
        baseline = row["claim"].partition(" than ")[2] or row["claim"].partition(" accurate as ")[2]
        kinds[kind].append(f"{baseline} ({difference:+.1f})")
    parts = [f"{_KINDS[kind]} {', '.join(found)}" for kind, found in kinds.items() if found]
    seeds = int(rows[0]["seeds"])
    suggested = any(row["verdict"].startswith("suggests") for row in rows)
    hint = f" [{seeds} seed{'s' if seeds > 1 else ''}: a suggestion]" if suggested else ""
    return f"{lens} is {'; '.join(parts)} points{hint}."
