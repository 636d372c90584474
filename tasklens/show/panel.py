"""Contents of the figure of a lens, and what its parts share: colours of fields and wavelengths, scale bars."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from torch import Tensor

from tasklens.optics.analysis import datasheet
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, evaluation_psf, lit_semi_diameters, trace_fields
from tasklens.optics.io import prescription, psf_files
from tasklens.optics.io.spec_section import view_of
from tasklens.optics.lens import Lens
from tasklens.optics.rays import Rays
from tasklens.optics.view import View

# Colours of Okabe and Ito, which colour-blind readers can tell apart; lines also differ in their dashes.
FIELD_COLOURS = ("#0072B2", "#009E73", "#D55E00")  # of axis, middle and corner
BY_WAVELENGTH = (  # in the order of a specification: red, green, blue
    {"color": "#CC3311", "ls": "-"},
    {"color": "#228833", "ls": "--"},
    {"color": "#4477AA", "ls": ":"},
)
RIM = 1.02  # drawn radius of a surface, as a multiple of the illuminated radius
_RAYS = 4096  # per field and wavelength
_LARGEST_BAR = 0.25  # share of the width of the plot


@dataclass(frozen=True)
class Panel:
    """Contents of the figure of one lens.

    Attributes:
        title: title of the figure.
        lens: lens with finite clear apertures.
        view: fields, wavelengths and pixels.
        psf: (F, 3, K, K) PSFs.
        figures: optical figures of the lens, for captions.
        rays: rays of all fields on the image plane.
        centre: (F, 2) image points of the chief rays [mm].
        narrowest_mm: length of the shortest lens of the figure; its scale bars fit.
        narrowest_um: width of the smallest PSF window of the figure.
        half_um: largest ray error that spots and ray fans show; None: half of the PSF window.
    """

    title: str
    lens: Lens
    view: View
    psf: Tensor
    figures: Mapping
    rays: Rays
    centre: Tensor
    narrowest_mm: float = math.inf
    narrowest_um: float = math.inf
    half_um: float | None = None

    @classmethod
    def of(cls, title: str, lens: Lens, view: View, psf: Tensor, figures: Mapping) -> "Panel":
        """Return the panel of a lens with its PSFs and figures."""
        rays = trace_fields(lens, view, sobol_disc(_RAYS, 0))
        return cls(title, lens, view, psf, figures, rays, chief_points(lens, view))

    @classmethod
    def read(cls, title: str, path: Path, psf: Path) -> "Panel":
        """Read the panel of a lens from the files of the lens and its PSFs; raises FileError."""
        prescribed, content = prescription.read(path)
        view = view_of(prescribed.lens, content, str(path))
        return cls.of(title, prescribed.lens, view, psf_files.read(psf, "nine").psf, content["figures"])

    @classmethod
    def compute(cls, title: str, lens: Lens, view: View, rays: int) -> "Panel":
        """Return the panel of a lens without study files: figures and PSFs are computed."""
        lens = lens.detached()
        psf = evaluation_psf(lens, view.in_colours(), rays).float()
        figures = datasheet.figures(lens, view, rays)
        view = view if len(view.wavelengths_um) < len(BY_WAVELENGTH) else view.in_colours()
        return cls.of(title, lens.with_clear_apertures(RIM * lit_semi_diameters(lens, view)), view, psf, figures)

    @property
    def shown_um(self) -> float:
        """Largest ray error that spots and ray fans show."""
        return self.half_um or self.view.kernel_size * self.view.pixel_pitch_um / 2

    @property
    def field_names(self) -> dict[int, str]:
        """Names by index of the drawn fields: nearest to the axis, in the middle, and in the corner."""
        return shown_fields(self.view)


def shown_fields(view: View) -> dict[int, str]:
    """Return the names by index of the fields nearest to the axis, in the middle, and in the corner."""
    names = view.named_fields
    return {field: name for name, field in names.items()} | {names["axis"]: "axis"}


def scale_bar(axes: Axes, unit: str, colour: str = "black", narrowest: float = math.inf) -> None:
    """Draw a bar of a round length (1, 2 or 5 times a power of ten in the unit of the x axis), labelled above.

    Args:
        axes: axes with their limits set.
        unit: unit of the x axis.
        colour: colour of the bar.
        narrowest: width of the narrowest plot of the figure, so that all bars have the same length.
    """
    low, high = axes.get_xlim()
    most = _LARGEST_BAR * min(abs(high - low), narrowest)
    power = 10.0 ** math.floor(math.log10(most))
    length = max(factor * power for factor in (1, 2, 5) if factor * power <= most)
    bar = AnchoredSizeBar(
        axes.transData,
        length,
        f"{length:g} {unit}",
        "lower right",
        frameon=False,
        color=colour,
        label_top=True,
        fontproperties=FontProperties(size=8),
    )
    axes.add_artist(bar)
