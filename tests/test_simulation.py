"""Captures of a whole sensor, compared with light that is traced from every pixel."""

import math
from dataclasses import replace

import numpy
import pytest
import torch
from examples import WAVELENGTHS, cooke_triplet, difference, f64, random_image
from kornia.color import rgb_to_linear_rgb
from PIL import Image
from torch import Tensor

import tasklens
from tasklens.camera.blend import SensorPsfs, blend
from tasklens.camera.sensor_psfs import pitch_on_sensor, trace_sensor_psfs
from tasklens.cli.app import main
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.object_points import magnification
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import chief_points, chief_rays, chief_rays_full, trace_fields
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.study.jobs.frames import resolution_chart

SHAPE = (96, 128)
RAYS = 1024


def blurred() -> tuple[Lens, View]:
    """A Cooke triplet out of focus, whose first surface vignettes, and a sensor of 225 um pixels."""
    whole = cooke_triplet()
    distance, clear = whole.thickness.clone(), whole.semi_diameter.clone()
    distance[-1] += 3.0
    clear[0] = 7.5
    fields = f64([[0.0, 0.0], [0.0, 9.0], [0.0, 18.0]])
    return replace(whole, thickness=distance, semi_diameter=clear), View(fields, 50.0, WAVELENGTHS, 225.0, 31)


def with_rear_aperture(share: float) -> tuple[Lens, View]:
    """The triplet with a last clear aperture of this share of the height of the last chief ray."""
    lens, view = blurred()
    behind = chief_rays_full(lens.with_open_apertures(), view)[2][-1]
    clear = lens.semi_diameter.clone()
    clear[-1] = share * float(torch.hypot(behind.x, behind.y)[-1, 0, 0])
    return replace(lens, semi_diameter=clear), view


@pytest.fixture(scope="module")
def traced() -> SensorPsfs:
    lens, view = blurred()
    return trace_sensor_psfs(lens, view, SHAPE, pitch_on_sensor(lens, view, SHAPE), RAYS)


def points(shape, pitch) -> Tensor:
    """Points (H, W, 2) of the pixels of a sensor [mm]."""
    rows, columns = (((torch.arange(n) - (n - 1) / 2) * (pitch / 1e3)).double() for n in shape)
    return torch.stack(torch.broadcast_tensors(columns, rows[:, None]), -1)


def traced_from_every_pixel(lens, view, image: Tensor, pitch: float, lit: tuple[slice, slice]) -> Tensor:
    """Follow each ray of the lit pixels to where it ends on the sensor, reflected at the edges of the frame.

    No window, node or transform: four weights per ray.
    """
    height, width = image.shape[1:]
    out = torch.zeros(3, height * width, dtype=torch.float64)
    at = replace(view, fields=points((height, width), pitch)[lit].flatten(0, 1))
    rays, chief = trace_fields(lens, at, sobol_disc(RAYS, seed=0)), chief_points(lens, at)
    pixel = torch.stack(torch.meshgrid(*map(torch.arange, (height, width)), indexing="ij"), -1)[lit].flatten(0, 1)
    light = image[(slice(None), *lit)].flatten(1).T.double()[..., None] / (~rays.vignetted).sum(-1, keepdim=True)
    ends = [
        pixel[:, axis, None, None] + (coordinate - chief[:, 1 - axis, None, None]) * (1e3 / pitch)
        for axis, coordinate in enumerate((rays.y, rays.x))
    ]
    for dy in (0, 1):
        for dx in (0, 1):
            weight, index = light * rays.valid, torch.zeros_like(rays.x, dtype=torch.int64)
            for end, step, n in zip(ends, (dy, dx), (height, width), strict=True):
                cell = end.floor() + step
                weight = weight * (1 - (end - cell).abs())
                inside = torch.where(cell < 0, -1 - cell, torch.where(cell > n - 1, 2 * n - 1 - cell, cell))
                assert ((inside >= 0) & (inside < n))[rays.valid].all()
                index = index * n + inside.nan_to_num().clamp(0, n - 1).long()
            for colour in range(3):
                out[colour].index_add_(0, index[:, colour].flatten(), weight[:, colour].flatten())
    return out.unflatten(1, (height, width))


@pytest.mark.parametrize(
    "lit",
    [(slice(66, 74), slice(86, 94)), (slice(44, 52), slice(120, 128)), (slice(0, 8), slice(0, 8))],
    ids=["between nodes", "edge", "corner"],
)
def test_a_capture_is_that_of_psfs_traced_from_every_pixel(traced, lit):
    """Within 1 % of what the lens does to the image, RMS, at edge, corner and between nodes; no light is lost."""
    lens, view = blurred()
    image = torch.zeros(3, *SHAPE)
    image[(slice(None), *lit)] = random_image((8, 8), seed=1)
    expected = traced_from_every_pixel(lens, view, image, pitch_on_sensor(lens, view, SHAPE), lit)
    capture = blend(image, traced)
    assert (capture - expected).norm() < 0.01 * (expected - image).norm()
    torch.testing.assert_close(capture.sum((1, 2)), image.sum((1, 2)), rtol=1e-5, atol=0)


def test_an_aperture_that_stops_the_chief_ray_darkens_the_corner():
    """A third of the corner's light passes a rear aperture, the chief ray not: the capture is complete."""
    lens, view = with_rear_aperture(0.98)
    rays = trace_fields(lens, view, sobol_disc(256, 0))
    assert not bool(chief_rays(lens, view).valid[-1]) and 0.05 < float(rays.valid[-1].double().mean()) < 0.6
    grey = tasklens.simulate_whole_sensor(lens, view, torch.full((3, 48, 64), 0.5), rays=64, illumination=True)
    assert grey.isfinite().all() and float(grey[1, 1, 1]) < float(grey[1, 24, 32])


@pytest.mark.slow
def test_distortion_puts_a_star_on_its_chief_ray_and_illumination_darkens_the_corner():
    lens, view = blurred()
    shape, pitch = (97, 129), 220.0
    star = torch.zeros(3, *shape)
    star[:, 80, 110] = 1
    field = points(shape, pitch)[80, 110]
    at = chief_points(lens, replace(view, fields=field[None]))[0] * (1e3 / pitch)
    spread = tasklens.simulate_whole_sensor(lens, view, star, pitch, rays=RAYS, distortion=True)[1].clamp(min=0)
    straight = tasklens.simulate_whole_sensor(lens, view, star, pitch, rays=RAYS)[1].clamp(min=0)

    def centre(capture):
        grid = torch.stack(torch.meshgrid(torch.arange(129) - 64.0, torch.arange(97) - 48.0, indexing="xy"), -1)
        return (grid * (capture / capture.sum())[..., None]).sum((0, 1))

    shift = (centre(spread) - centre(straight)).double()
    expected = at - field * (1e3 / pitch)
    assert expected.norm() > 0.3 and (shift - expected).norm() < 0.15
    corner = points(shape, pitch)[2, 2].norm()
    expected_light = relative_illumination(lens, replace(view, fields=f64([[0, 0], [0, corner]])))
    for colour, within in (("linear", 0.02), ("srgb", 0.04)):  # the latter averages sRGB values of unequal light
        grey = torch.full((3, *shape), 0.8)
        dark = tasklens.simulate_whole_sensor(lens, view, grey, pitch, colour=colour, illumination=True, rays=RAYS)
        dark = rgb_to_linear_rgb(dark)  # illumination is a ratio of light
        assert float(dark[1, 2, 2] / dark[1, 48, 64]) == pytest.approx(float(expected_light[1]), rel=within)


def test_a_lens_with_strong_barrel_distortion_is_simulated():
    """The corner images a field more than 1.25 times as far out as in a pinhole camera."""
    stop = {"radius": math.inf, "thickness": 0.8, "stop": True}
    surfaces = [stop, {"radius": 3, "thickness": 0.8, "material": "COC"}, {"radius": -3}]
    lens, view = tasklens.lens(surfaces, field_of_view_deg=60, f_number=20, pixel_pitch_um=60.0, kernel_size=15)
    corner = float(view.radii.max())
    assert float(chief_points(lens, view.along_y(f64([1.25 * corner])))[0].norm()) < 0.96 * corner
    image = random_image((48, 64), seed=3)
    capture = tasklens.simulate_whole_sensor(lens, view, image, rays=64, distortion=True)
    assert capture.shape == image.shape and capture.isfinite().all()


def test_linear_light_differs_from_srgb_values_but_not_of_an_even_image():
    lens, view = blurred()
    image = random_image((40, 48), seed=8)
    pitch = pitch_on_sensor(lens, view, (40, 48)) * 0.5
    first = [tasklens.simulate_whole_sensor(lens, view, image, pitch, colour=c, rays=64) for c in ("srgb", "linear")]
    assert (first[0] - first[1]).abs().mean() > 1e-3
    even = tasklens.simulate_whole_sensor(lens, view, torch.full_like(image, 0.5), pitch, colour="linear", rays=64)
    assert (even - 0.5).abs().max() < 0.01


def test_the_pixel_pitch_is_that_at_which_an_image_fills_the_sensor():
    lens, view = blurred()  # 36 mm across
    assert pitch_on_sensor(lens, view, (96, 128)) == 225
    assert pitch_on_sensor(lens, view, (48, 64)) == 450
    assert pitch_on_sensor(lens, replace(view, pixel_pitch_um=223.0), (96, 128)) == 223  # nearly full: as it was made
    near = replace(view, object_vergence=1 / 300)  # the image of a near object is larger
    first_order = paraxial(lens, near.reference_um)
    object_height = 18 / float(first_order.efl) * (300 + float(first_order.entrance_pupil_z))
    height = abs(magnification(lens, near)) * object_height
    assert height > 1.1 * 18
    assert pitch_on_sensor(lens, near, (96, 128)) == pytest.approx(2e3 * height / 160, rel=1e-9)


def test_a_sensor_without_light_in_its_corner_is_refused():
    lens, view = with_rear_aperture(0.5)
    with pytest.raises(InputError, match=r"no light arrives \d+\.\d+ mm from the axis .* smaller field of view"):
        tasklens.simulate_whole_sensor(lens, view, torch.zeros(3, *SHAPE), rays=16)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"image": torch.zeros(1, 96, 128)}, r"a tensor \(3, H, W\), got \(1, 96, 128\)"),
        ({"image": torch.zeros(3, 20, 128)}, "20 x 128 pixels: too small"),
        ({"image_pixel_pitch_um": 3000.0}, "corners at 237.* smaller pixel pitch"),
    ],
)
def test_what_cannot_be_simulated_is_refused(change, message):
    lens, view = blurred()
    arguments = {"image": torch.zeros(3, *SHAPE), "rays": 16, **change}
    with pytest.raises(InputError, match=message):
        tasklens.simulate_whole_sensor(lens=lens, view=view, **arguments)


def test_the_chart_is_grey_where_lines_are_finer_than_pixels_and_the_same_upside_down():
    """Half of a star is black, and line pairs of 8 pixels are resolved."""
    chart = resolution_chart(216, 384)
    assert chart.shape == (3, 216, 384) and chart.min() >= 0 and chart.max() == 1
    star = chart[0, 88:128, 172:212]
    assert float(star.mean()) == pytest.approx(0.5, abs=0.02)
    assert float(star[18:22, 18:22].std()) < 0.2 < float(star.std())


@pytest.mark.slow
def test_a_distorted_image_is_differentiable_in_the_lens():
    """The origin of a pixel's light moves with the lens, too; the illumination is held constant."""
    lens, view = blurred()
    lens = replace(lens, semi_diameter=cooke_triplet().semi_diameter)  # whole pupils: no jumps
    ramp = torch.linspace(0.2, 0.8, 3 * 40 * 60).reshape(3, 40, 60)

    def corner(curvature: Tensor, held: bool = False) -> Tensor:
        shaped = replace(lens, curvature=curvature)
        captured = tasklens.simulate_whole_sensor(shaped, view, ramp, rays=256, distortion=True, illumination=held)
        return captured[:, :5, :5].mean()

    start = lens.curvature.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(corner(start), start)
    for surfaces in (slice(1, 4), slice(4, None)):  # all of them bent equally
        along = torch.zeros_like(gradient)
        along[surfaces] = 1.0
        (expected,) = difference(lambda t, along=along: corner(lens.curvature + t * along), torch.zeros(1), 1e-4)
        assert float(gradient @ along) == pytest.approx(float(expected), rel=0.1)
    assert torch.autograd.grad(corner(start, held=True), start)[0].isfinite().all()


@pytest.mark.slow
def test_a_person_simulates_the_whole_sensor(tmp_path, capsys):
    """The command writes what `simulate_whole_sensor` returns, and refuses options that would have no effect."""
    lens, view = blurred()
    path, image, output = (str(tmp_path / name) for name in ("lens.yaml", "image.png", "capture.png"))
    tasklens.save_lens(path, lens, view)
    values = (255 * random_image((48, 64), seed=9)).byte().movedim(0, -1).numpy()
    Image.fromarray(values).save(image)
    command = ["lens", "simulate", path, image, "-o", output, "--rays", "64"]
    assert main([*command, "--whole-sensor", "--distortion", "--illumination"]) == 0
    own = tasklens.load_lens(path)
    expected = tasklens.simulate_whole_sensor(*own, image, distortion=True, illumination=True, rays=64)
    pixels = torch.from_numpy(numpy.array(Image.open(output))).movedim(-1, 0)
    assert (pixels - 255 * expected.clamp(0, 1)).abs().max() <= 0.51
    assert main([*command, "--force", "--whole-sensor", "--true-pixels", "--pixel-pitch", "20"]) == 0
    pitched = tasklens.load_lens(path, pixel_pitch_um=20.0)
    expected = tasklens.simulate_whole_sensor(*pitched, image, image_pixel_pitch_um=20.0, rays=64)
    pixels = torch.from_numpy(numpy.array(Image.open(output))).movedim(-1, 0)
    assert (pixels - 255 * expected.clamp(0, 1)).abs().max() <= 0.51
    for options in (["--illumination"], ["--true-pixels"], ["--whole-sensor", "--grid"]):
        assert main([*command, "--force", *options]) == 2
        assert "--whole-sensor" in capsys.readouterr().err
