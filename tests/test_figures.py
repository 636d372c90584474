"""Figures of a lens: required labels, and reproducible files."""

from dataclasses import replace

import pytest
import torch
from examples import HEADLINE, f64
from matplotlib.figure import Figure
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from PIL import Image

import tasklens
from tasklens.optics.analysis import datasheet
from tasklens.optics.analysis.focus import move_image_plane
from tasklens.optics.analysis.mtf import geometric_mtf, limited_mtf, perfect_mtf
from tasklens.optics.analysis.spots import evaluation_psf, spot_diagram
from tasklens.optics.view import View, view_of_spec
from tasklens.settings.specification import Spec
from tasklens.show import curves, figures, spot_panels
from tasklens.show.panel import Panel, shown_fields


@pytest.fixture(scope="module")
def panel(start):
    """A random doublet, which is far from sharp."""
    view = view_of_spec(Spec(kernel_size=11))
    values = datasheet.figures(start, view, 64)
    return Panel.of("random", start, view, evaluation_psf(start, view, 64), values)


@pytest.fixture(scope="module")
def sharp():
    """A published triplet by least squares."""
    return Panel.compute("sharp", *tasklens.load_lens(HEADLINE / "triplet-imaging3.yaml"), 256)


def draw(function, panel) -> Figure:
    figure = Figure(layout="constrained")
    function(figure, panel)
    return figure


def legend_of(figure: Figure) -> list[str]:
    """Texts of all legends of a figure and its axes."""
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    return [text.get_text() for legend in legends if legend is not None for text in legend.get_texts()]


def bars_of(figure: Figure) -> list[str]:
    """Texts of the scale bars of a figure."""
    bars = [artist for axes in figure.axes for artist in axes.artists if isinstance(artist, AnchoredSizeBar)]
    return [bar.txt_label.get_text() for bar in bars]


def test_the_spots_say_what_each_colour_and_circle_is(panel):
    figure = draw(spot_panels.draw_spots, panel)
    labels = legend_of(figure)
    assert [f"{1e3 * wavelength:.0f} nm" for wavelength in panel.view.wavelengths_um] == labels[:3]
    assert labels[3:] == ["chief ray", "core: 50 % about the chief ray", "80 % about the chief ray", "Airy radius"]
    assert len(bars_of(figure)) == 1 and len(figure.axes) == len(panel.psf)
    for axes, field in zip(figure.axes, panel.view.radii.argsort(stable=True).tolist(), strict=True):
        half = panel.view.kernel_size * panel.view.pixel_pitch_um / 2
        assert axes.get_xlim() == axes.get_ylim() == (-half, half)  # y upward
        assert f"RMS {panel.figures['rms_centroid_um'][field]:.1f} um" in axes.get_xlabel()
        radii = sorted(patch.radius for patch in axes.patches)
        circles = [panel.figures[name][field] for name in ("core_radius_um", "radius_80_um")]
        circles = [radius for radius in circles if radius < 1e3 * half]
        assert radii == sorted([*circles, panel.figures["airy_radius_um"]])


def test_curves_against_field_and_focus(sharp):
    """MTFs keep below the diffraction limit; the RMS spot ends at that of the corner; a peak out of focus is shown."""
    mtf = draw(curves.draw_curves, sharp).axes[0]
    *lines, limit = (line.get_ydata() for line in mtf.get_lines())
    assert len(lines) == 2 * len(sharp.field_names) and all((line <= limit + 2e-3).all() for line in lines)
    spot = draw(curves.draw_sharpness, sharp).axes[0].get_lines()[0].get_ydata()
    assert spot[-1] == pytest.approx(max(sharp.figures["rms_centroid_um"]), rel=0.02)
    limits = []
    for shift_um in (0.0, 60.0):
        moved = move_image_plane(sharp.lens, shift_um / 1e3)
        axes = draw(curves.draw_focus, Panel.of("moved", moved, sharp.view, sharp.psf, sharp.figures)).axes[0]
        axis = axes.get_lines()[0]
        low, high = axes.get_xlim()
        limits.append(high)
        peak = axis.get_xdata()[axis.get_ydata().argmax()]
        assert low < peak < high and peak == pytest.approx(-shift_um, abs=12)
    assert limits[0] < limits[1]


def test_the_limit_of_a_field_is_that_of_its_rays(sharp):
    """On the axis the cut-off is that of the F-number; in the corner, where rays are oblique, it is lower."""
    frequencies = [50.0, 150.0]
    by_rays = geometric_mtf(sharp.rays, sharp.view.directions, frequencies)
    limited = limited_mtf(sharp.rays, sharp.view.directions, frequencies, sharp.view.reference_um)
    tangential, sagittal = (product / rays for product, rays in zip(limited, by_rays, strict=True))
    on_axis = perfect_mtf(torch.tensor(frequencies), sharp.figures["diffraction_cutoff_per_mm"])
    torch.testing.assert_close(tangential[0], on_axis.double(), rtol=0.02, atol=0)
    torch.testing.assert_close(tangential[0], sagittal[0], rtol=0.01, atol=0)
    corner = int(sharp.view.radii.argmax())
    assert (tangential[corner] < sagittal[corner]).all() and (sagittal[corner] < on_axis).all()


def test_the_strip_has_the_psfs_of_all_fields_upward(panel):
    figure = draw(spot_panels.draw_psfs, panel)
    assert len(figure.axes) == 2 * len(panel.psf) and len(set(bars_of(figure))) == 1
    assert all(axes.get_images()[0].origin == "lower" for axes in figure.axes)


def test_section_and_curves_have_legends_and_a_scale_bar(panel):
    section, charts = draw(figures.draw_section, panel), draw(curves.draw_curves, panel)
    labels = legend_of(section)
    assert "stop" in labels and all(
        any(text.startswith(name) for text in labels) for name in panel.field_names.values()
    )
    assert len(bars_of(section)) == 1 and bars_of(section)[0].endswith(" mm")
    labels = legend_of(charts)
    assert {"axis T", "corner S", "perfect, axis", "axis", "a pixel", "Airy radius", "PSF window"} <= set(labels)


@pytest.mark.slow
def test_a_figure_drawn_twice_is_the_same_file(panel, tmp_path):
    """PNG, SVG and PDF, without a date; the SVG contains text, the PNG an image."""
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        paths = [tmp_path / folder / f"lens.{kind}" for kind in ("png", "svg", "pdf")]
        figures.save(figures.figure_of([panel]), paths)
    for kind in ("png", "svg", "pdf"):
        first, second = ((tmp_path / folder / f"lens.{kind}").read_bytes() for folder in ("first", "second"))
        assert first == second, kind
    with Image.open(tmp_path / "first" / "lens.png") as picture:
        assert picture.width > 1000 and len(picture.convert("RGB").getcolors(1 << 24)) > 100
    assert figures.figure_of([panel])._repr_png_().startswith(b"\x89PNG")  # as a notebook displays it
    assert "geometric × diffraction limit" in (tmp_path / "first" / "lens.svg").read_text()
    assert (tmp_path / "first" / "lens.pdf").read_bytes().startswith(b"%PDF")


def test_scale_bars_of_lenses_in_one_figure_agree(panel):
    """Bars of a lens four times as long, with windows four times as wide, have the same lengths as the small lens's."""
    lens, view = panel.lens.scaled(4.0), replace(panel.view, pixel_pitch_um=4 * panel.view.pixel_pitch_um)
    large = Panel.of("large", lens, view, panel.psf, panel.figures)
    both = bars_of(figures.figure_of([panel, large]))
    assert sorted(both)[::2] == sorted(both)[1::2]
    assert bars_of(draw(figures.draw_section, large))[0] not in both  # alone, its bar is longer


@pytest.mark.parametrize("factor", [0.01, 3.0])
def test_spots_of_any_size_fill_their_frame(panel, factor):
    """A round scale holds at least 95 % of the rays, and at most two and a half times their spread."""
    offset = panel.rays.x - panel.centre[:, 0, None, None]
    rays = replace(panel.rays, x=panel.rays.x + (factor - 1) * offset)
    (axes, *_) = [axes for axes in figures.figure_of([replace(panel, rays=rays)]).axes if "core" in axes.get_xlabel()]
    half = axes.get_xlim()[1]
    distances = 1e3 * spot_diagram(rays, panel.centre).norm(dim=-1)
    spread = float(distances[distances.isfinite()].quantile(0.95))
    assert spread <= half <= 2.5 * spread


@pytest.mark.parametrize(
    "heights, names",
    [([0.0], {0: "axis"}), ([1.0, 0.0], {1: "axis", 0: "corner"}), ([0, 2, 1], {0: "axis", 2: "middle", 1: "corner"})],
)
def test_fields_are_named_by_their_distance_from_the_axis(heights, names):
    view = View(f64([[0.0, height] for height in heights]), 2.9, (0.6, 0.55, 0.5), 1.8, 11)
    assert shown_fields(view) == names and list(shown_fields(view)) == list(names)
