"""Charts of the page, as JSON for plotly: colours by elements, symbols by design.

Colours are those of Okabe and Ito; no chart relies on colour alone. Charts are black on white here; the page's script
recolours them for the reader's theme.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas
import plotly.graph_objects as go

from tasklens.study.report.measurements import FIELD

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#777777")
SYMBOLS = (
    *("circle", "square", "diamond", "cross", "x", "triangle-up", "triangle-down", "star", "pentagon"),
    *("hexagram", "bowtie", "hourglass", "triangle-left", "triangle-right", "circle-open", "square-open"),
    *("diamond-open", "star-open", "asterisk-open", "hash-open"),
)
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_POINTS = 160  # most points of a curve
_TICKS = [m * 10**e for e in range(-1, 4) for m in (1, 2, 5)]  # of logarithmic axes
_LEGEND = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}


@dataclass(frozen=True)
class Chart:
    """A chart: name, title, a description in words for readers who cannot see it, and its JSON for plotly."""

    key: str
    title: str
    words: str
    json: str


def _chart(key: str, title: str, words: str, figure: go.Figure, height: int, **layout: Any) -> Chart:
    figure.update_layout(template="none", height=height, margin={"l": 60, "r": 10, "t": 10, "b": 50}, **layout)
    text = figure.to_json()
    assert text is not None
    return Chart(key, title, words, text.replace("<", "\\u003c"))  # the JSON is inside a script element


def _line(k: int) -> dict[str, Any]:
    """Return the style of the line number `k` of a chart."""
    return {"width": 1.5, "color": COLOURS[k % len(COLOURS)], "dash": _DASHES[k // len(COLOURS) % len(_DASHES)]}


def colour_of(names: Sequence[str], name: str) -> str:
    """Return the colour of a name among all names."""
    return COLOURS[list(names).index(name) % len(COLOURS)]


def accuracy_over_rms(table: pandas.DataFrame) -> Chart | None:
    """Chart the accuracy of every lens of table 1 against its RMS spot; None without lenses."""
    lenses = table[table["elements"] != ""].dropna(subset=["accuracy", "rms_spot_um"])
    if lenses.empty:
        return None
    elements, designs = list(dict.fromkeys(lenses["elements"])), list(dict.fromkeys(lenses["design"]))
    figure = go.Figure()
    for row in lenses.to_dict("records"):
        figure.add_scatter(
            x=[row["rms_spot_um"]],
            y=[row["accuracy"]],
            error_y={"array": [row["accuracy_std"]], "thickness": 1} if "accuracy_std" in row else None,
            mode="markers",
            name=f"{row['elements']} {row['design']}",
            legendgroup=row["design"],
            showlegend=False,
            marker={
                "size": 11,
                "color": colour_of(elements, row["elements"]),
                "symbol": SYMBOLS[designs.index(row["design"]) % len(SYMBOLS)],
            },
            hovertemplate="%{fullData.name}<br>%{y:.1f} % at %{x:.2f} um RMS<extra></extra>",
        )
    for name in elements:
        marker = {"size": 11, "color": colour_of(elements, name), "symbol": "circle"}
        figure.add_scatter(x=[None], y=[None], mode="markers", name=name, marker=marker, hoverinfo="skip")
    for k, name in enumerate(designs):
        marker = {"size": 10, "color": "#888888", "symbol": SYMBOLS[k % len(SYMBOLS)]}
        figure.add_scatter(x=[None], y=[None], mode="markers", name=name, legendgroup=name, marker=marker)
    sharp = table[table["design"] == "reference"]["accuracy"]
    if len(sharp):
        figure.add_hline(y=float(sharp.iloc[0]), line={"dash": "dash", "width": 1, "color": "#888888"})
    best = lenses.iloc[int(lenses["accuracy"].argmax())]
    words = (
        f"Accuracy [%] against RMS spot radius [um] for {len(lenses)} lenses. Most accurate: {best['elements']} "
        f"{best['design']}, {best['accuracy']:.1f} % at {best['rms_spot_um']:.1f} um. Colour: elements; symbol: "
        "design; dashed line: sharp images. Click a design in the legend to hide its lenses."
    )
    axes = {
        "xaxis": {"type": "log", "title": {"text": "RMS spot radius [um]"}, "tickvals": _TICKS},
        "yaxis": {"title": {"text": "accuracy [%]"}},
    }
    return _chart("accuracy", "Accuracy and sharpness", words, figure, 600, legend=_LEGEND, hovermode="closest", **axes)


def accuracy_by_radius(
    elements: str, by_seed: pandas.DataFrame, radii: Sequence[float], seen: Sequence[float]
) -> Chart | None:
    """Chart the accuracy of the designs of some elements over the radius, mean over seeds; None without such columns.

    Args:
        radii: distance of each field of the grading from the axis, in units of that of the corner.
        seen: distances of the fields that designs see, marked by lines; empty if they are drawn.
    """
    columns = {f"{FIELD}{k}": radius for k, radius in enumerate(radii)}
    if "corner_accuracy" in by_seed:
        columns["corner_accuracy"] = 1.0
    fields = sorted((name for name in columns if name in by_seed), key=lambda name: columns[name])
    rows = by_seed[by_seed["elements"] == elements].dropna(subset=fields)
    if not fields or rows.empty:
        return None
    means = rows.groupby("design", sort=False)[fields].mean()
    figure = go.Figure()
    for radius in dict.fromkeys(round(radius, 4) for radius in seen):
        figure.add_vline(x=radius, line={"dash": "dot", "width": 1, "color": "#888888"})
    for k, (design, values) in enumerate(means.iterrows()):
        figure.add_scatter(
            x=[round(columns[name], 4) for name in fields],
            y=values.round(2).tolist(),
            mode="lines+markers",
            name=str(design),
            line=_line(k),
        )
    corner = "; ".join(f"{design} {value:.1f}" for design, value in means[fields[-1]].items())
    words = f"Accuracy [%] over the distance from the axis; 1 is the corner of the sensor. Farthest out: {corner}."
    words += " Dotted: fields that designs see." if len(seen) else " Designs see fields drawn over the whole sensor."
    axes = {
        "xaxis": {"title": {"text": "distance from the axis [of the corner]"}, "range": [0, 1.02]},
        "yaxis": {"title": {"text": "accuracy [%]"}},
    }
    title = f"Accuracy by radius: {elements}"
    return _chart(f"fields-{elements}", title, words, figure, 420, legend=_LEGEND, showlegend=True, **axes)


def differences(key: str, title: str, table: pandas.DataFrame, labels: Sequence[str]) -> Chart | None:
    """Chart differences with their intervals, one below the other."""
    rows = table.assign(label=list(labels)).dropna(subset=["difference"])
    if rows.empty:
        return None
    figure = go.Figure()
    figure.add_scatter(
        x=rows["difference"],
        y=rows["label"],
        mode="markers",
        marker={"size": 10, "color": COLOURS[0], "symbol": "diamond"},
        error_x={
            "symmetric": False,
            "array": rows["high"] - rows["difference"],
            "arrayminus": rows["difference"] - rows["low"],
            "thickness": 1.5,
            "color": COLOURS[0],
        },
        hovertemplate="%{y}<br>%{x:+.1f} points<extra></extra>",
        showlegend=False,
    )
    figure.add_vline(x=0, line={"width": 1, "color": "#888888"})
    values = (f"{row['label']} {row['difference']:+.1f}" for row in rows.to_dict("records"))
    words = f"Differences in points of accuracy with their 95 % intervals: {'; '.join(values)}."
    axes = {
        "xaxis": {"title": {"text": "difference [points of accuracy]"}, "zeroline": False},
        "yaxis": {"autorange": "reversed", "automargin": True},
    }
    return _chart(key, title, words, figure, 110 + 34 * len(rows), **axes)


def histories(
    key: str, title: str, column: str, unit: str, runs: Mapping[str, pandas.DataFrame], words: str, log: bool
) -> Chart | None:
    """Chart a column of the histories of several runs against the share of the run; None if no run has the column.

    The description ends with the last value of each run.
    """
    figure, ends = go.Figure(), []
    for k, (name, history) in enumerate(runs.items()):
        if column not in history:
            continue
        valid = pandas.to_numeric(history[column], errors="coerce").dropna()
        if valid.empty:
            continue
        ends.append(f"{name} {valid.iloc[-1]:.4g}")
        sample = valid.iloc[:: max(1, len(valid) // _POINTS)]
        figure.add_scatter(
            x=(sample.index.to_numpy() + 1) / len(history), y=sample.round(5), mode="lines", name=name, line=_line(k)
        )
    if not ends:
        return None
    words += f" Last values: {'; '.join(ends)}."
    axes = {
        "xaxis": {"title": {"text": "share of the steps"}, "tickformat": ".0%", "range": [0, 1]},
        "yaxis": {"title": {"text": unit}} | ({"type": "log", "tickvals": _TICKS} if log else {}),
    }
    return _chart(key, title, words, figure, 520, legend=_LEGEND, showlegend=True, **axes)
