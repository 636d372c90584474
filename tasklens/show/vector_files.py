"""Settings of matplotlib for vector figures: text stays text, and equal figures are equal files."""

from typing import Any

STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "tasklens", "pdf.fonttype": 42}
METADATA = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
