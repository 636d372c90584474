"""A scale bar in a corner of a plot."""

import math

from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

_LARGEST = 0.25  # share of the width of the plot


def scale_bar(axes: Axes, unit: str, colour: str = "black", narrowest: float = math.inf) -> None:
    """Draw a bar of a round length (1, 2 or 5 times a power of ten in the unit of the x axis), labelled above.

    Args:
        axes: axes with their limits set.
        unit: unit of the x axis.
        colour: colour of the bar.
        narrowest: width of the narrowest plot of the figure, so that all bars have the same length.
    """
    low, high = axes.get_xlim()
    most = _LARGEST * min(abs(high - low), narrowest)
    power = 10.0 ** math.floor(math.log10(most))
    length = max(factor * power for factor in (1, 2, 5) if factor * power <= most)
    font = FontProperties(size=8)
    bar = AnchoredSizeBar(
        axes.transData,
        length,
        f"{length:g} {unit}",
        "lower right",
        frameon=False,
        color=colour,
        label_top=True,
        fontproperties=font,
    )
    axes.add_artist(bar)
