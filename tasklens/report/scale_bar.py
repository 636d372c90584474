"""A scale bar in a corner of a plot."""

from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar


def scale_bar(axes: Axes, length: float, label: str, colour: str = "black", place: str = "lower right") -> None:
    """Draw a bar of a length in units of the x axis, with its label above."""
    font = FontProperties(size=8)
    bar = AnchoredSizeBar(
        axes.transData, length, label, place, frameon=False, color=colour, label_top=True, fontproperties=font
    )
    axes.add_artist(bar)
