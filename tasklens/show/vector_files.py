"""Vector figures by matplotlib: text stays text, and equal figures are equal files."""

import io
from typing import Any

import matplotlib
from matplotlib.figure import Figure

STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "tasklens", "pdf.fonttype": 42}
METADATA = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}


def svg(figure: Figure) -> str:
    """Return a figure as SVG."""
    text = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(text, format="svg", metadata=METADATA["svg"])
    return text.getvalue()
